"""A point fixed in the cell, met with the tool's tip from many sides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.closure import Closure
from gapbridge.core.calibration.observables.fixed_point import fixed_at
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.model import Poses


@dataclass(frozen=True)
class Point(Closure):
    """The target stands on a point that nobody knows, the same one at each reading of a place."""

    registered: bool = False
    kind: ClassVar[str] = "point"
    equations: ClassVar[int] = 3

    def gap(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return the way from the target to the point (N, 3), base axes."""
        return -self.apart(poses, readings, nuisance)

    def directions(self, apart: Array) -> Array:
        """Return the base axes (N, 3, 3)."""
        return np.broadcast_to(np.eye(3), (len(apart), 3, 3))

    def guess(self, poses: Poses, readings: Readings) -> Nuisance:
        """Return the middle of where the target was."""
        layout = self.layout(readings)
        places = []
        for s in range(layout.stations):
            position = poses.position[readings.station == s]
            places.append(fixed_at(np.median(position, axis=0) if len(position) else np.zeros(3)))
        return Nuisance(tuple(places), np.zeros((layout.targets, 3)), np.zeros(layout.stations))
