"""Instruments that a person reads: numbers typed, or pasted from the clipboard, at the terminal."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    S,
    Samples,
    Where,
)
from gapbridge.bridge.calibration.instruments.numbers import FARTHEST, coordinates, numbers
from gapbridge.bridge.cell.settings.instruments import (
    METRES,
    DialGaugeSettings,
    TwoBallsSettings,
    TypedSettings,
)

NEAREST = 1e-3  # m between two balls


class _Typed(Instrument[S]):
    manual = True
    waits = True


class Typed(_Typed[TypedSettings]):
    """A person reads a display and types; several lines pasted at once count one by one."""

    @property
    def name(self) -> str:
        """Return what is typed."""
        return f"readings typed in {self.settings.unit}"

    def read(self, where: Where) -> Samples:
        """Return one sample (1, 3) or (1, 6). Raises ReadingError."""
        given = self.settings
        what = "x y z" if not given.pose else f"x y z and {given.rotation}"
        line = self.around.ask(f"{what}, {given.unit}")
        return Samples(coordinates(numbers(line, given.width, given.unit), given)[None])


class DialGauge(_Typed[DialGaugeSettings]):
    """A dial gauge, draw wire or ballbar: one distance a pose, to which ``zero`` is added."""

    stands = "its fixed end"

    @property
    def name(self) -> str:
        """Return what is typed."""
        return f"distances typed in {self.settings.unit}"

    def read(self, where: Where) -> Samples:
        """Return one sample (1, 1), m. Raises ReadingError."""
        given = self.settings
        (dial,) = numbers(self.around.ask(f"dial, {given.unit}"), 1, given.unit)
        distance = (dial + (given.zero or 0.0)) * METRES[given.unit]
        low = 0.0 if given.zero is not None else -FARTHEST
        if not low < distance < FARTHEST:
            raise ReadingError(
                f"found a distance of {distance:g} m, expected more than {low:g} and less "
                f"than {FARTHEST:g}: are unit and zero right?"
            )
        return Samples(np.array([[distance]]))


class TwoBalls(_Typed[TwoBallsSettings]):
    """Two balls on the tool, measured one after the other; the instrument may stand anywhere."""

    @property
    def name(self) -> str:
        """Return what is typed."""
        return f"two balls typed in {self.settings.unit}"

    def read(self, where: Where) -> Samples:
        """Return one sample (1, 3), m: second ball minus first. Raises ReadingError."""
        unit = self.settings.unit
        first, second = (
            np.array(numbers(self.around.ask(f"{which} ball x y z, {unit}"), 3, unit))
            * METRES[unit]
            for which in ("first", "second")
        )
        if np.linalg.norm(second - first) < NEAREST:
            raise ReadingError("found both balls at the same place, expected two")
        return Samples((second - first)[None])
