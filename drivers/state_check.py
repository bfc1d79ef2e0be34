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
        self.lower: Vector = np.maximum(arm.limits.lower - BEYOND, -LARGEST_ANGLE)
        self.upper: Vector = np.minimum(arm.limits.upper + BEYOND, LARGEST_ANGLE)
        self.fastest: Vector = np.broadcast_to(np.asarray(fastest, float), self.lower.shape)

    def outside(self, q: Vector) -> str | None:
        """Return what is wrong with angles (n,) rad that no such arm can have; None: nothing."""
        wrong = ~((q >= self.lower) & (q <= self.upper))  # NaN is not within
        if not wrong.any():
            return None
        joint = int(np.argmax(wrong))
        if not np.isfinite(q[joint]):
            return f"joint {joint + 1}: found {q[joint]:g}, expected a finite angle"
        return (
            f"joint {joint + 1}: found {q[joint]:.4f} rad, far outside the arm's limits: another "
            "arm, another zero, or other units"
        )

    def jumped(self, step: Vector, gap: float) -> str | None:
        """Return which joint cannot have moved by ``step`` (n,) rad in ``gap`` s; None: all can."""
        way = np.abs(step)
        most = self.fastest * gap + JITTER
        if not (way > most).any():
            return None
        joint = int(np.argmax(way - most))
        return f"joint {joint + 1}: found a step of {way[joint]:.4f} rad in {gap:.4f} s"
