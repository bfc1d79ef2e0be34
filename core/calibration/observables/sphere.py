"""A sphere fixed in the cell, touched with a ball on the tool from many sides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.closure import Closure
from gapbridge.core.calibration.observables.fixed_point import (
    TINY,
    fixed_at,
    sphere_through,
    trilaterated,
)
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.model import Poses


@dataclass(frozen=True)
class Sphere(Closure):
    """The target touches a sphere: it stands one radius from a centre that nobody knows.

    ``radius`` (m) is the sphere's and the ball's together; None: found along, and with it the size
    of the arm is known by its drawing alone.
    """

    registered: bool = False
    radius: float | None = None
    kind: ClassVar[str] = "sphere"
    equations: ClassVar[int] = 1

    @property
    def free_length(self) -> bool:
        """Return whether the radius is unknown."""
        return self.radius is None

    def gap(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return how far the target is inside the sphere (N, 1)."""
        long = np.linalg.norm(self.apart(poses, readings, nuisance), axis=1)
        return np.asarray((nuisance.lengths[readings.station] - long)[:, None])

    def directions(self, apart: Array) -> Array:
        """Return the sphere's normal (N, 1, 3)."""
        long = np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), TINY)
        return np.asarray((apart / long)[:, None])

    def guess(self, poses: Poses, readings: Readings) -> Nuisance:
        """Return the spheres through the target's positions."""
        layout = self.layout(readings)
        places, lengths = [], np.zeros(layout.stations)
        for s in range(layout.stations):
            position = poses.position[readings.station == s]
            if self.radius is None:
                centre, lengths[s] = sphere_through(position)
            else:
                lengths[s] = self.radius
                centre = trilaterated(position, np.full(len(position), self.radius))
            places.append(fixed_at(centre))
        return Nuisance(tuple(places), np.zeros((layout.targets, 3)), lengths)
