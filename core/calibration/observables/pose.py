"""Whole poses of the tool: a tracker with a six-axis probe, a camera that sees a marker board."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.observables.position import (
    MIN_POINTS,
    in_instrument,
    measured_in_base,
    station_frame,
    with_targets,
)
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.estimation.registration import Registration
from gapbridge.core.model import Poses
from gapbridge.core.rotation import rotation_matrix, rotation_vector


@dataclass(frozen=True)
class Pose(Observable):
    """Position of a target (m) and rotation vector of the tool (rad), in the place's frame."""

    registered: bool = False
    lever: float = 0.1  # m: 1 sigma of a rotation is that of a coordinate over this
    kind: ClassVar[str] = "pose"
    width: ClassVar[int] = 6
    equations: ClassVar[int] = 6
    frame: ClassVar[tuple[int, ...]] = (0, 1, 2, 3, 4, 5)

    @property
    def sigmas(self) -> Array:
        """Return one for positions (m), 1/lever for rotations (rad)."""
        return np.array([1.0, 1, 1, *[1 / self.lever] * 3])

    def gap(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return measured minus predicted (N, 6): position, then the turn between them."""
        target = self.target_position(poses, readings, nuisance)
        frames = nuisance.frames(readings.station)[0]
        measured = np.swapaxes(frames, 1, 2) @ rotation_matrix(readings.value[:, 3:])
        shift = measured_in_base(readings, nuisance) - target
        return np.hstack([shift, rotation_vector(measured @ np.swapaxes(poses.rotation, 1, 2))])

    def reading(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return position and rotation vector in the instrument's frame (N, 6)."""
        target = self.target_position(poses, readings, nuisance)
        position = in_instrument(target, readings, nuisance)
        rotation = nuisance.frames(readings.station)[0] @ poses.rotation
        return np.hstack([position, rotation_vector(rotation)])

    def initial_nuisance(self, poses: Poses, readings: Readings) -> Nuisance:
        """Return frames from the positions of each place, or from its rotations if too few."""
        layout = self.layout(readings)
        nuisance = Nuisance.zero(layout.stations, layout.targets)
        if layout.frame:
            frames = []
            for s in range(layout.stations):
                rows = readings.station == s
                if rows.sum() > MIN_POINTS:
                    frames.append(station_frame(poses, readings, s))
                else:
                    frames.append(_frame_of_rotations(poses, readings, rows))
            nuisance = Nuisance(tuple(frames), nuisance.targets, nuisance.lengths)
        return with_targets(poses, readings, nuisance)


def _frame_of_rotations(poses: Poses, readings: Readings, rows: NDArray[np.bool_]) -> Registration:
    """Return the frame that the measured rotations of some readings determine."""
    if not rows.any():
        return Registration(np.eye(3), np.zeros(3))
    turns = rotation_matrix(readings.value[rows, 3:]) @ np.swapaxes(poses.rotation[rows], 1, 2)
    U, _, Vt = np.linalg.svd(turns.sum(axis=0))
    rotation = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    position = np.median(readings.value[rows, :3] - poses.position[rows] @ rotation.T, axis=0)
    return Registration(rotation, position)
