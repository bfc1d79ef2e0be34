"""The way from one ball on the tool to another, whatever shift the instrument has."""

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
    It shows how the tool is turned, not where it is.
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
        """Return measured minus predicted way (N, 3), base axes."""
        frames, _ = nuisance.frames(readings.station)
        measured = np.einsum("nji,nj->ni", frames, readings.value)
        return np.asarray(measured - _way(poses, readings, nuisance))

    def reading(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return the way in the instrument's axes (N, 3)."""
        frames, _ = nuisance.frames(readings.station)
        return np.asarray(np.einsum("nij,nj->ni", frames, _way(poses, readings, nuisance)))

    def guess(self, poses: Poses, readings: Readings) -> Nuisance:
        """Return axes and ways from the linear equations frame^T measured = rotation way."""
        layout = self.layout(readings)
        nuisance = Nuisance.zero(layout.stations, layout.targets)
        for s in range(layout.stations if layout.frame else 0):
            own = readings.station == s
            if own.any():
                nuisance = _with_axes(poses, readings, nuisance, s)
        targets = nuisance.targets.copy()
        measured = self.gap(poses, readings, replace(nuisance, targets=np.zeros_like(targets)))
        ways = np.einsum("nji,nj->ni", poses.rotation, measured)
        for t in range(1, layout.targets):
            own = np.maximum(readings.target, 1) == t
            if own.any():
                targets[t] = np.median(ways[own], axis=0)
        return replace(nuisance, targets=targets)


def _way(poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
    way = (nuisance.targets - nuisance.targets[0])[np.maximum(readings.target, 1)]
    return np.asarray(np.einsum("nij,nj->ni", poses.rotation, way))


def _with_axes(poses: Poses, readings: Readings, nuisance: Nuisance, station: int) -> Nuisance:
    """Return the nuisance with the axes of one place: least singular vector of the equations."""
    own = readings.station == station
    ball = np.maximum(readings.target[own], 1)
    count, balls = int(own.sum()), len(nuisance.targets)
    A = np.zeros((count, 3, 9 + 3 * balls))
    for k in range(3):
        A[:, k, 3 * k : 3 * k + 3] = readings.value[own]
    for t in range(1, balls):
        A[ball == t, :, 9 + 3 * t : 12 + 3 * t] = -poses.rotation[own][ball == t]
    unknown = np.r_[0:9, 12 : 9 + 3 * balls]
    found = np.linalg.svd(A.reshape(3 * count, -1)[:, unknown])[2][-1]
    turn = found[:9].reshape(3, 3)
    U, _, Vt = np.linalg.svd(turn * np.sign(np.linalg.det(turn) or 1.0))
    stations = list(nuisance.stations)
    stations[station] = Registration((U @ Vt).T, IDENTITY.position)
    return replace(nuisance, stations=tuple(stations))
