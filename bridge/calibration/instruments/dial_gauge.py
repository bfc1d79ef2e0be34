"""A dial gauge, draw wire or ballbar: one distance a pose."""

from __future__ import annotations

import numpy as np

from bridge.calibration.instruments.instrument import Instrument, ReadingError, Samples, Where
from bridge.calibration.instruments.numbers import FARTHEST, numbers
from bridge.calibration.instruments.settings import METRES, DialGaugeSettings


class DialGauge(Instrument[DialGaugeSettings]):
    """A person reads the dial and types what stands there; ``zero`` is added."""

    manual = True
    waits = True

    @property
    def name(self) -> str:
        """Return what is typed."""
        return f"distances typed in {self.settings.unit}"

    def read(self, where: Where) -> Samples:
        """Return one sample (1, 1), m. Raises ReadingError."""
        given = self.settings
        (dial,) = numbers(self.around.ask(f"dial, {given.unit}"), 1, given.unit)
        distance = (dial + given.zero) * METRES[given.unit]
        if not 0.0 < distance < FARTHEST:
            raise ReadingError(
                f"found a distance of {distance:g} m, expected more than 0 and less than "
                f"{FARTHEST:g}: are unit and zero right?"
            )
        return Samples(np.array([[distance]]))
