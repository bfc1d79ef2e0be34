"""Bringing the arm to something that stands still, with joint angles as the only reading."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.fixed_point import point_of
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
