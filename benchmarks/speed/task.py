"""The arm and the rows that every row of the benchmark works on. Seeded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import builtin_arm
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

Array = NDArray[np.float64]
DAMPING = 1e-3  # m
AXIAL = np.array([3e-6, 5e-6, 4e-6, 8e-6, 8e-6, 9e-6])  # rad/Nm
RADIAL = np.full(6, 1e-6)


def rigid() -> Model:
    """Return a UR10e with a tool off its last axis, which carries 2 kg."""
    tool = np.eye(4)
    tool[:3, 3] = (0.1, 0.05, 0.2)
    return Model(builtin_arm("ur10e"), tool, 2.0, np.array([0.0, 0.02, 0.1]))


def deflected() -> Model:
    """Return the same with flexible joints."""
    return rigid().with_compliance(AXIAL, RADIAL)


def rows(count: int, seed: int = 0) -> tuple[Array, Loads]:
    """Return joint angles (count, 6) and pulls on the tool."""
    rng = np.random.default_rng(seed)
    q = np.array([0.0, -1.2, 1.5, -1.8, -1.5, 0.0]) + rng.uniform(-1.5, 1.5, (count, 6))
    return q, Loads(wrench=rng.normal(0, 30, (count, 6)) * [1, 1, 1, 0.1, 0.1, 0.1])


def path(count: int) -> Array:
    """Return setpoints (count, 6) of a motion at 500 Hz: about 0.5 rad/s."""
    t = 0.002 * np.arange(count)[:, None]
    return np.array([0.3, -1.2, 1.5, -1.8, -1.5, 0.2]) + 0.3 * np.sin(t * np.arange(1, 7) * 0.5)
