"""A dial gauge, draw wire or ballbar: one distance a pose."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    Samples,
    Where,
)
from gapbridge.bridge.calibration.instruments.numbers import FARTHEST, numbers
from gapbridge.bridge.cell.settings.instruments import METRES, DialGaugeSettings


class DialGauge(Instrument[DialGaugeSettings]):
    """A person reads the dial and types what stands there; ``zero`` is added."""

    manual = True
    waits = True
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
