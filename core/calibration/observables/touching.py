"""Contact of the tool with a fixed object, with joint angles as the only reading.

The tool's tip on a fixed point from many sides, or a ball on the tool touching a fixed sphere.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.fixed_point import (
    TINY,
    fitted_sphere,
    fixed_at,
    point_of,
    trilaterated,
)
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.model import Model, Poses
from gapbridge.core.rotation import skew

NEWTON_ROUNDS = 25
GAP_CONVERGED = 1e-10  # m
MAX_GAP = 1e-6  # m: a larger gap counts as not converged
MAX_STEP = 0.3  # rad, of one joint in a step


class Closure(Observable):
    """A kind without an instrument: the target is in contact where the gap is zero."""

    closes = True
    unknown = True
    frame: ClassVar[tuple[int, ...]] = (0, 1, 2)
    width: ClassVar[int] = 0

    @abstractmethod
    def directions(self, offset: Array) -> Array:
        """Return the directions (N, k, 3) of the gap for an ``offset`` (N, 3), m, base."""

    def offset(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return the vector from the place's fixed point to the target (N, 3), m, base."""
        points = np.array([point_of(place) for place in nuisance.stations])
        target = self.target_position(poses, readings, nuisance)
        return np.asarray(target - points[readings.station])

    def reading(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return nothing (N, 0): no instrument is read."""
        return np.zeros((len(readings), 0))

    def solve_joints(self, model: Model, q: Array, readings: Readings, nuisance: Nuisance) -> Array:
        """Return joints (N, n), rad, near ``q`` that close the gap; rows of nan where none do.

        Newton with the smallest step in joint space; ``readings`` hold load, place and target.
        """
        q, rows = q.copy(), np.arange(len(q))
        for _ in range(NEWTON_ROUNDS):
            part, q_rows = readings[rows], q[rows]
            poses = model.predict(q_rows, part.loads)
            gap = self.gap(poses, part, nuisance)
            unsolved = np.abs(gap).max(axis=1) > GAP_CONVERGED
            if not unsolved.any():
                return q
            step = self._step(model, poses, q_rows, part, nuisance)
            q[rows[unsolved]] += step[unsolved]
            rows = rows[unsolved]
        gap = self.gap(model.predict(q, readings.loads), readings, nuisance)
        q[np.abs(gap).max(axis=1) > MAX_GAP] = np.nan
        return q

    def _step(
        self, model: Model, poses: Poses, q: Array, readings: Readings, nuisance: Nuisance
    ) -> Array:
        """Return the smallest steps (N, n), rad, that close the gap to first order, limited."""
        whole = model.linear_form(q, readings.loads).jacobian
        lever = np.einsum("nij,nj->ni", poses.rotation, nuisance.targets[readings.target])
        moving = whole[:, :3] - skew(lever) @ whole[:, 3:]
        J = self.directions(self.offset(poses, readings, nuisance)) @ moving
        gap = self.gap(poses, readings, nuisance)
        step = np.einsum("njk,nk->nj", np.linalg.pinv(J, rcond=1e-6), gap)
        size = np.abs(step).max(axis=1, keepdims=True)
        return np.asarray(step * np.minimum(1.0, MAX_STEP / np.maximum(size, 1e-12)))


@dataclass(frozen=True)
class Point(Closure):
    """The target is at an unknown fixed point, the same for all readings of a place."""

    registered: bool = False
    kind: ClassVar[str] = "point"
    equations: ClassVar[int] = 3

    def gap(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return the vector from the target to the point (N, 3), m, base axes."""
        return -self.offset(poses, readings, nuisance)

    def directions(self, offset: Array) -> Array:
        """Return the base axes (N, 3, 3)."""
        return np.broadcast_to(np.eye(3), (len(offset), 3, 3))

    def initial_nuisance(self, poses: Poses, readings: Readings) -> Nuisance:
        """Return the median target position of each place."""
        layout = self.layout(readings)
        places = []
        for s in range(layout.stations):
            position = poses.position[readings.station == s]
            places.append(fixed_at(np.median(position, axis=0) if len(position) else np.zeros(3)))
        return Nuisance(tuple(places), np.zeros((layout.targets, 3)), np.zeros(layout.stations))


@dataclass(frozen=True)
class Sphere(Closure):
    """The target touches a sphere: it is one radius away from an unknown centre.

    ``radius`` (m) is the sum of the sphere's and the ball's; None: it is estimated, and the
    readings then determine no absolute length.
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
        """Return the penetration of the target into the sphere (N, 1), m."""
        distance = np.linalg.norm(self.offset(poses, readings, nuisance), axis=1)
        return np.asarray((nuisance.lengths[readings.station] - distance)[:, None])

    def directions(self, offset: Array) -> Array:
        """Return the sphere's normal (N, 1, 3)."""
        distance = np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), TINY)
        return np.asarray((offset / distance)[:, None])

    def initial_nuisance(self, poses: Poses, readings: Readings) -> Nuisance:
        """Return the spheres through the target's positions."""
        layout = self.layout(readings)
        places, lengths = [], np.zeros(layout.stations)
        for s in range(layout.stations):
            position = poses.position[readings.station == s]
            if self.radius is None:
                centre, lengths[s] = fitted_sphere(position)
            else:
                lengths[s] = self.radius
                centre = trilaterated(position, np.full(len(position), self.radius))
            places.append(fixed_at(centre))
        return Nuisance(tuple(places), np.zeros((layout.targets, 3)), lengths)
