"""The force sensor in the flange: the controller reports its reading together with the joints."""

from __future__ import annotations

from typing import Self

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    Samples,
    Surroundings,
    Where,
)
from gapbridge.bridge.cell.settings.instruments import Base


class FlangeSensor(Instrument[Base]):
    """Nothing to read beside the arm's own state."""

    waits = True
    needs_wrench = True

    @classmethod
    def here(cls, around: Surroundings) -> Self:
        """Return the sensor of the cell's controller."""
        return cls(Base(), around)

    @property
    def kind(self) -> str:
        """Return ``wrench``: no kind of position reading."""
        return "wrench"

    @property
    def name(self) -> str:
        """Return what it is."""
        return "the flange's force sensor"

    def read(self, where: Where) -> Samples:
        """Return no number (1, 0): the wrench stands beside the joints."""
        return Samples(np.zeros((1, 0)))
