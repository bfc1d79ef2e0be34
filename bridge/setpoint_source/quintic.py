"""Smooth moves as trajectories: quintic polynomials, at rest at both ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gapbridge.bridge.document.output_file import write_table
from gapbridge.core.arrays import Array


def quintic_time(distance: Array, top_speed: Array | float, acceleration: float) -> float:
    """Return the shortest time (s) of a move by ``distance`` (n,), rad, joints together.

    ``top_speed`` in rad/s, of each joint or all; ``acceleration`` in rad/s2, of the fastest joint.
    """
    slowest = float((np.abs(distance) / top_speed).max())
    return max(1.875 * slowest, float(np.sqrt(5.774 * np.abs(distance).max() / acceleration)))


def quintic(begin: Array, end: Array, steps: int) -> Array:
    """Return joints (steps + 1, n) from ``begin`` to ``end``, in equal steps of time."""
    s = np.linspace(0, 1, steps + 1)[:, None]
    return np.asarray(begin + (end - begin) * (10 * s**3 - 15 * s**4 + 6 * s**5))


def write_trajectory(path: Path, q: Array, period: float) -> float:
    """Write joints (N, n) at every ``period`` s as a trajectory's CSV; returns its length, s."""
    t = np.arange(len(q)) * period
    names = ["timestamp", *(f"target_q_{i}" for i in range(q.shape[1]))]
    write_table(path, names, np.column_stack([t, q]))
    return float(t[-1])
