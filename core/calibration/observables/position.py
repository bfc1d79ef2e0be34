"""Positions of a target, as a laser tracker or a photogrammetry system reads them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.estimation.registration import Registration, register_robustly
from gapbridge.core.model import Poses
from gapbridge.core.rotation import skew

MIN_POINTS = 3  # points that determine a frame


@dataclass(frozen=True)
class Position(Observable):
    """Where a target is (m), in the frame of the instrument's place."""

    registered: bool = False
    kind: ClassVar[str] = "position"
    width: ClassVar[int] = 3
    equations: ClassVar[int] = 3
    frame: ClassVar[tuple[int, ...]] = (0, 1, 2, 3, 4, 5)

    def gap(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return measured minus predicted position (N, 3), base axes."""
        target = self.target_position(poses, readings, nuisance)
        return measured_in_base(readings, nuisance) - target

    def jacobian(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return d gap / d (TCP translation, rotation) as (N, 3, 6), base axes."""
        lever = np.einsum("nij,nj->ni", poses.rotation, nuisance.targets[readings.target])
        shift = np.broadcast_to(-np.eye(3), (len(lever), 3, 3))
        return np.concatenate([shift, skew(lever)], axis=2)

    def reading(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return the position in the instrument's frame (N, 3)."""
        return in_instrument(self.target_position(poses, readings, nuisance), readings, nuisance)

    def initial_nuisance(self, poses: Poses, readings: Readings) -> Nuisance:
        """Return frames from the readings of each place, then the targets' points."""
        layout = self.layout(readings)
        nuisance = Nuisance.zero(layout.stations, layout.targets)
        if layout.frame:
            frames = [station_frame(poses, readings, s) for s in range(layout.stations)]
            nuisance = Nuisance(tuple(frames), nuisance.targets, nuisance.lengths)
        return with_targets(poses, readings, nuisance)


def measured_in_base(readings: Readings, nuisance: Nuisance) -> Array:
    """Return measured positions (N, 3) in base."""
    rotation, position = nuisance.frames(readings.station)
    return np.asarray(np.einsum("nji,nj->ni", rotation, readings.value[:, :3] - position))


def in_instrument(position: Array, readings: Readings, nuisance: Nuisance) -> Array:
    """Return positions (N, 3) of base in the frame of each reading's place."""
    rotation, origin = nuisance.frames(readings.station)
    return np.asarray(np.einsum("nij,nj->ni", rotation, position) + origin)


def station_frame(poses: Poses, readings: Readings, station: int) -> Registration:
    """Return the frame of one place, from target 0 where it was read often enough."""
    rows = readings.station == station
    first = rows & (readings.target == 0)
    use = first if first.sum() >= MIN_POINTS else rows
    if not use.any():
        return Registration(np.eye(3), np.zeros(3))
    return register_robustly(readings.value[use, :3], poses.position[use])


def with_targets(poses: Poses, readings: Readings, nuisance: Nuisance) -> Nuisance:
    """Return the nuisance with the points of the targets beyond the first."""
    targets = nuisance.targets.copy()
    gap = measured_in_base(readings, nuisance) - poses.position
    in_tool = np.einsum("nji,nj->ni", poses.rotation, gap)
    for t in range(1, len(targets)):
        rows = readings.target == t
        if rows.any():
            targets[t] = np.median(in_tool[rows], axis=0)
    return Nuisance(nuisance.stations, targets, nuisance.lengths)
