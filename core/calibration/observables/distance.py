"""Distances from a fixed point: a ballbar, a draw wire, a dial gauge on a ball."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.fixed_point import fixed_at, point_of, trilaterated
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.model import Poses


@dataclass(frozen=True)
class Distance(Observable):
    """Distance (m) from an unknown fixed point to a target; each place has a separate point."""

    registered: bool = False  # not used: the fixed point is always estimated
    zeroed: bool = False  # True: readings count from an unknown zero of the place (a dial gauge)
    kind: ClassVar[str] = "distance"
    width: ClassVar[int] = 1
    equations: ClassVar[int] = 1
    frame: ClassVar[tuple[int, ...]] = (0, 1, 2)
    unknown: ClassVar[bool] = True

    @property
    def free_length(self) -> bool:
        """Return whether the zero of the gauge is unknown."""
        return self.zeroed

    def gap(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return measured minus predicted distance (N, 1)."""
        return readings.value - self.reading(poses, readings, nuisance)

    def reading(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return the distance from the place's fixed point, minus its zero (N, 1), m."""
        points = np.array([point_of(place) for place in nuisance.stations])
        offset = self.target_position(poses, readings, nuisance) - points[readings.station]
        distance = np.linalg.norm(offset, axis=1) - nuisance.lengths[readings.station]
        return np.asarray(distance[:, None])

    def initial_nuisance(self, poses: Poses, readings: Readings) -> Nuisance:
        """Return the points by trilateration; an unknown zero is tried over the arm's reach."""
        layout = self.layout(readings)
        points, zeros = [], np.zeros(layout.stations)
        for s in range(layout.stations):
            rows = readings.station == s
            position, value = poses.position[rows], readings.value[rows, 0]
            reach = float(np.ptp(poses.position, axis=0).max(initial=0.0))
            tried = np.linspace(0, reach, 21) if self.zeroed else np.zeros(1)
            fits = []
            for zero in tried:
                point = trilaterated(position, value + zero)
                gap = np.linalg.norm(position - point, axis=1) - zero - value
                fits.append((float(np.median(np.abs(gap))), float(zero), point))
            _, zeros[s], point = min(fits, key=lambda one: one[0])
            points.append(fixed_at(point))
        return Nuisance(tuple(points), np.zeros((layout.targets, 3)), zeros)
