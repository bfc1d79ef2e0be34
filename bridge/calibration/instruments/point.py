"""A fixed point met with the tool's tip: joint angles alone, no metrology at all."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    Samples,
    Where,
)
from gapbridge.bridge.cell.settings.instruments import PointSettings


class TipOnPoint(Instrument[PointSettings]):
    """A person brings the tool's tip onto one fixed point and says so."""

    waits = True
    seats = True
    stands = "the point"

    @property
    def name(self) -> str:
        """Return what is done."""
        return "tip on a fixed point"

    def read(self, where: Where) -> Samples:
        """Return one sample without any number (1, 0), once the tip is on the point."""
        if answer := self.around.ask("tip on the point? Enter"):
            raise ReadingError(f"found {answer!r}, expected Enter")
        return Samples(np.zeros((1, 0)))
