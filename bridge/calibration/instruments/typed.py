"""Instruments read by the operator: numbers are typed or pasted at the terminal."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    ReadRequest,
    S,
    Samples,
)
from gapbridge.bridge.calibration.instruments.numbers import MAX_RANGE, parse_numbers, to_si
from gapbridge.bridge.cell.settings.instruments import (
    METRES,
    DialGaugeSettings,
    TwoBallsSettings,
    TypedSettings,
)

MIN_BALL_DISTANCE = 1e-3  # m between the centres


class _TypedReading(Instrument[S]):
    manual = True
    self_triggered = True


class TypedCoordinates(_TypedReading[TypedSettings]):
    """Coordinates typed by the operator; of several pasted lines each is one reading."""

    @property
    def name(self) -> str:
        """Return its name with the unit."""
        return f"readings typed in {self.settings.unit}"

    def read(self, request: ReadRequest) -> Samples:
        """Return one sample: (1, 3) m, or (1, 6) m and rotation vector. Raises ReadingError."""
        settings = self.settings
        names = "x y z" if not settings.pose else f"x y z and {settings.rotation}"
        line = self.context.ask(f"{names}, {settings.unit}")
        return Samples(to_si(parse_numbers(line, settings.width, *settings.units), settings)[None])


class DialGauge(_TypedReading[DialGaugeSettings]):
    """A dial gauge, draw wire or ballbar: one distance per pose, ``zero`` added."""

    placed_part = "its fixed end"

    @property
    def name(self) -> str:
        """Return its name with the unit."""
        return f"distances typed in {self.settings.unit}"

    def read(self, request: ReadRequest) -> Samples:
        """Return one sample (1, 1), m. Raises ReadingError."""
        settings = self.settings
        (dial,) = parse_numbers(self.context.ask(f"dial, {settings.unit}"), 1, settings.unit)
        distance = (dial + (settings.zero or 0.0)) * METRES[settings.unit]
        low = 0.0 if settings.zero is not None else -MAX_RANGE
        if not low < distance < MAX_RANGE:
            raise ReadingError(
                f"found a distance of {distance:g} m, expected more than {low:g} and less "
                f"than {MAX_RANGE:g}: are unit and zero right?"
            )
        return Samples(np.array([[distance]]))


class TwoBalls(_TypedReading[TwoBallsSettings]):
    """Two balls on the tool, measured one after the other, in any frame of fixed orientation."""

    @property
    def name(self) -> str:
        """Return its name with the unit."""
        return f"two balls typed in {self.settings.unit}"

    def read(self, request: ReadRequest) -> Samples:
        """Return one sample (1, 3), m: second ball minus first. Raises ReadingError."""
        unit = self.settings.unit
        first, second = (
            np.array(parse_numbers(self.context.ask(f"{which} ball x y z, {unit}"), 3, unit))
            * METRES[unit]
            for which in ("first", "second")
        )
        if np.linalg.norm(second - first) < MIN_BALL_DISTANCE:
            raise ReadingError("found both balls at the same place, expected two")
        return Samples((second - first)[None])
