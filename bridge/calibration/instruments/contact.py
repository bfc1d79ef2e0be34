"""A fixed sphere touched by the tool's probe: joint angles alone, no metrology at all."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    Samples,
    Where,
)
from gapbridge.bridge.cell.settings.instruments import SphereSettings


class Sphere(Instrument[SphereSettings]):
    """A person brings the probe onto the sphere and says so."""

    waits = True
    seats = True
    stands = "the sphere"

    @property
    def name(self) -> str:
        """Return what is done."""
        return "probe on a fixed sphere"

    def read(self, where: Where) -> Samples:
        """Return one sample without any number (1, 0), once the probe sits on the sphere."""
        if answer := self.around.ask("probe seated on the sphere? Enter"):
            raise ReadingError(f"found {answer!r}, expected Enter")
        return Samples(np.zeros((1, 0)))
