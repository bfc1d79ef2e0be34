"""Bringing the arm to something that stands still, with joint angles as the only reading.

A point fixed in the cell, met with the tool's tip from many sides; a sphere, touched with a ball on
the tool.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.fixed_point import (
    TINY,
    fixed_at,
    point_of,
    sphere_through,
    trilaterated,
)
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.model import Model, Poses
from gapbridge.core.rotation import skew

NEWTON_ROUNDS = 25
CLOSED = 1e-10  # m
MISSED = 1e-6  # m: farther off than this, no pose was found
LONGEST = 0.3  # rad, of one joint in a step


class Closure(Observable):
    """A kind without an instrument: the target touches where the gap is zero."""

    closes = True
    unknown = True
    frame: ClassVar[tuple[int, ...]] = (0, 1, 2)
    width: ClassVar[int] = 0

    @abstractmethod
    def directions(self, apart: Array) -> Array:
        """Return the directions (N, k, 3) that measure the gap; ``apart`` (N, 3) is seen."""

    def apart(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return the way from the place's fixed point to the target (N, 3), base."""
        points = np.array([point_of(place) for place in nuisance.stations])
        return np.asarray(self.seen(poses, readings, nuisance) - points[readings.station])

    def reading(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return nothing (N, 0): no instrument is read."""
        return np.zeros((len(readings), 0))

    def brought(self, model: Model, q: Array, readings: Readings, nuisance: Nuisance) -> Array:
        """Return joints (N, n) near ``q`` that close the gap; rows of nan where none are found.

        Newton with the smallest step in joint space; ``readings`` give load, place and target.
        """
        q, open_rows = q.copy(), np.arange(len(q))
        for _ in range(NEWTON_ROUNDS):
            part, at = readings[open_rows], q[open_rows]
            poses = model.predict(at, part.loads)
            gap = self.gap(poses, part, nuisance)
            left = np.abs(gap).max(axis=1) > CLOSED
            if not left.any():
                return q
            step = self._step(model, poses, at, part, nuisance)
            q[open_rows[left]] += step[left]
            open_rows = open_rows[left]
        gap = self.gap(model.predict(q, readings.loads), readings, nuisance)
        q[np.abs(gap).max(axis=1) > MISSED] = np.nan
        return q

    def _step(
        self, model: Model, poses: Poses, q: Array, readings: Readings, nuisance: Nuisance
    ) -> Array:
        """Return the smallest steps (N, n) that close the gap to first order, cut to size."""
        whole = model.linear_form(q, readings.loads).jacobian
        lever = np.einsum("nij,nj->ni", poses.rotation, nuisance.targets[readings.target])
        moving = whole[:, :3] - skew(lever) @ whole[:, 3:]
        J = self.directions(self.apart(poses, readings, nuisance)) @ moving
        gap = self.gap(poses, readings, nuisance)
        step = np.einsum("njk,nk->nj", np.linalg.pinv(J, rcond=1e-6), gap)
        size = np.abs(step).max(axis=1, keepdims=True)
        return np.asarray(step * np.minimum(1.0, LONGEST / np.maximum(size, 1e-12)))


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
