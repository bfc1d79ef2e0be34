"""Whether a sample can be believed: one set of limits, one check, for all drivers and the loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import Arm

Vector = NDArray[np.float64]
FASTEST = 20.0  # rad/s: joints that move faster between two samples are a mistake
JITTER = 0.01  # rad: of one reading
BEYOND = 0.35  # rad past a joint limit: another arm, another zero, or other units
LARGEST_ANGLE = 1e4  # rad, of a joint without limits
LARGEST = {
    "position": 20.0, "velocity": 60.0, "torque": 1e4, "temperature": 300.0, "force": 1e4,
    "moment": 1e4, "current": 1e3,
}  # fmt: skip
"""Largest plausible magnitudes, SI units; a position where the arm's limits are not at hand."""


class JointCheck:
    """Checks joint angles against the arm's limits and against the sample before."""

    def __init__(self, arm: Arm, fastest: Vector | float = FASTEST) -> None:
        lower = np.maximum(arm.limits.lower - BEYOND, -LARGEST_ANGLE)
        upper = np.minimum(arm.limits.upper + BEYOND, LARGEST_ANGLE)
        # plain numbers: a few of them cost less than one call on arrays
        self._range = [*zip(lower.tolist(), upper.tolist(), strict=True)]
        self._speed = np.broadcast_to(np.asarray(fastest, float), lower.shape).tolist()

    def outside(self, q: Vector) -> str | None:
        """Return what is wrong with angles (n,) rad that no such arm can have; None: nothing."""
        within = [low <= v <= high for v, (low, high) in zip(q.tolist(), self._range, strict=True)]
        if all(within):  # NaN is not within
            return None
        joint = within.index(False)
        if not np.isfinite(q[joint]):
            return f"joint {joint + 1}: found {q[joint]:g}, expected a finite angle"
        return (
            f"joint {joint + 1}: found {q[joint]:.4f} rad, far outside the arm's limits: another "
            "arm, another zero, or other units"
        )

    def jumped(self, step: Vector, gap: float) -> str | None:
        """Return which joint cannot have moved by ``step`` (n,) rad in ``gap`` s; None: all can."""
        way = [*map(abs, step.tolist())]
        beyond = [v - (f * gap + JITTER) for v, f in zip(way, self._speed, strict=True)]
        if not any(v > 0.0 for v in beyond):
            return None
        joint = beyond.index(max(beyond))
        return f"joint {joint + 1}: found a step of {way[joint]:.4f} rad in {gap:.4f} s"
