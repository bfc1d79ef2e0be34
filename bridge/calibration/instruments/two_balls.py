"""Two balls on the tool, measured one after the other: their difference counts."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    Samples,
    Where,
)
from gapbridge.bridge.calibration.instruments.numbers import numbers
from gapbridge.bridge.cell.settings.instruments import METRES, TwoBallsSettings

NEAREST = 1e-3  # m between two balls


class TwoBalls(Instrument[TwoBallsSettings]):
    """A person measures both balls at each pose; the instrument may stand anywhere."""

    manual = True
    waits = True

    @property
    def name(self) -> str:
        """Return what is typed."""
        return f"two balls typed in {self.settings.unit}"

    def read(self, where: Where) -> Samples:
        """Return one sample (1, 3), m: second ball minus first. Raises ReadingError."""
        unit = self.settings.unit
        points = []
        for which in ("first", "second"):
            line = self.around.ask(f"{which} ball x y z, {unit}")
            points.append(np.array(numbers(line, 3, unit)) * METRES[unit])
        difference = points[1] - points[0]
        if np.linalg.norm(difference) < NEAREST:
            raise ReadingError("found both balls at the same place, expected two")
        return Samples(difference[None])
