"""Registration of an instrument's frame to the robot's base."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.estimation.robust import start_weights
from gapbridge.core.rotation import rotation_matrix, skew

ROUNDS = 8


@dataclass(frozen=True)
class Registration:
    """The instrument's frame: measured = rotation @ position_in_base + position."""

    rotation: Array  # (3, 3) base axes in the instrument's
    position: Array  # (3,) m, base origin in the instrument's frame

    def in_base(self, measured: Array) -> Array:
        """Return measured positions (N, 3) in base."""
        return np.asarray((measured - self.position) @ self.rotation)

    def rotation_in_base(self, measured: Array) -> Array:
        """Return measured rotations (N, 3, 3) in base."""
        return np.asarray(self.rotation.T @ measured)

    def moved(self, step: Array) -> Registration:
        """Return the frame after a small step (6,): what ``frame_columns`` multiplies."""
        # measured in base becomes R @ (.) + step[:3], with R the rotation of step[3:]
        rotation = self.rotation @ rotation_matrix(step[3:]).T
        return Registration(rotation, self.position - rotation @ step[:3])


IDENTITY = Registration(np.eye(3), np.zeros(3))


def register(measured: Array, predicted: Array, weights: Array | None = None) -> Registration:
    """Return the rigid frame that maps ``predicted`` (N, 3) best to ``measured`` (N, 3), m.

    Weighted least squares (Kabsch 1976), a proper rotation.
    """
    w = np.ones(len(measured)) if weights is None else weights
    w = w / w.sum()
    centre_m, centre_p = w @ measured, w @ predicted
    U, _, Vt = np.linalg.svd((measured - centre_m).T @ (w[:, None] * (predicted - centre_p)))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    rotation = U @ D @ Vt
    return Registration(rotation, centre_m - rotation @ centre_p)


def register_robustly(measured: Array, predicted: Array) -> Registration:
    """Return the frame with outliers down-weighted, as the start of a fit."""
    frame = register(measured, predicted)
    for _ in range(ROUNDS):
        gap = frame.in_base(measured) - predicted
        frame = register(measured, predicted, start_weights(gap))
    return frame


def frame_columns(position: Array) -> Array:
    """Return d(measured in base) / d(frame step) (N, 6, 6): position rows, then rotation rows."""
    columns = np.zeros((len(position), 6, 6))
    columns[:, :3, :3] = np.eye(3)
    columns[:, :3, 3:] = -skew(position)
    columns[:, 3:, 3:] = np.eye(3)
    return columns
