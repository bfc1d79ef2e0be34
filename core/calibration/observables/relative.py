"""The vector from one ball on the tool to another, independent of the instrument's position."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.estimation.registration import IDENTITY, Registration
from gapbridge.core.model import Poses


@dataclass(frozen=True)
class Relative(Observable):
    """Second ball minus first (m), in the instrument's axes; both sit on the tool.

    ``Readings.target`` numbers the second ball, from 1 (0 counts as 1); the first is ball 0.
    The reading depends on the tool's rotation only, not on its position.
    """

    registered: bool = False
    kind: ClassVar[str] = "relative"
    width: ClassVar[int] = 3
    equations: ClassVar[int] = 3
    frame: ClassVar[tuple[int, ...]] = (3, 4, 5)

    def targets_of(self, readings: Readings) -> int:
        """Return how many balls there are: at least two."""
        return max(super().targets_of(readings), 2)

    def gap(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return measured minus predicted vector (N, 3), base axes."""
        frames, _ = nuisance.frames(readings.station)
        measured = np.einsum("nji,nj->ni", frames, readings.value)
        return np.asarray(measured - _ball_vector(poses, readings, nuisance))

    def reading(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return the vector in the instrument's axes (N, 3)."""
        frames, _ = nuisance.frames(readings.station)
        return np.asarray(np.einsum("nij,nj->ni", frames, _ball_vector(poses, readings, nuisance)))

    def initial_nuisance(self, poses: Poses, readings: Readings) -> Nuisance:
        """Return axes and vectors from the linear equations frame^T measured = rotation vector."""
        layout = self.layout(readings)
        nuisance = Nuisance.zero(layout.stations, layout.targets)
        for s in range(layout.stations if layout.frame else 0):
            rows = readings.station == s
            if rows.any():
                nuisance = _with_axes(poses, readings, nuisance, s)
        targets = nuisance.targets.copy()
        measured = self.gap(poses, readings, replace(nuisance, targets=np.zeros_like(targets)))
        vectors = np.einsum("nji,nj->ni", poses.rotation, measured)
        for t in range(1, layout.targets):
            rows = np.maximum(readings.target, 1) == t
            if rows.any():
                targets[t] = np.median(vectors[rows], axis=0)
        return replace(nuisance, targets=targets)


def _ball_vector(poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
    vector = (nuisance.targets - nuisance.targets[0])[np.maximum(readings.target, 1)]
    return np.asarray(np.einsum("nij,nj->ni", poses.rotation, vector))


def _with_axes(poses: Poses, readings: Readings, nuisance: Nuisance, station: int) -> Nuisance:
    """Return the nuisance with the axes of one place: least singular vector of the equations."""
    rows = readings.station == station
    ball = np.maximum(readings.target[rows], 1)
    count, balls = int(rows.sum()), len(nuisance.targets)
    A = np.zeros((count, 3, 9 + 3 * balls))
    for k in range(3):
        A[:, k, 3 * k : 3 * k + 3] = readings.value[rows]
    for t in range(1, balls):
        A[ball == t, :, 9 + 3 * t : 12 + 3 * t] = -poses.rotation[rows][ball == t]
    unknown = np.r_[0:9, 12 : 9 + 3 * balls]
    found = np.linalg.svd(A.reshape(3 * count, -1)[:, unknown])[2][-1]
    turn = found[:9].reshape(3, 3)
    U, _, Vt = np.linalg.svd(turn * np.sign(np.linalg.det(turn) or 1.0))
    stations = list(nuisance.stations)
    stations[station] = Registration((U @ Vt).T, IDENTITY.position)
    return replace(nuisance, stations=tuple(stations))
