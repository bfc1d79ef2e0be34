"""The motion of one run: smooth moves from pose to pose, with a rest at each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.document.output_file import write_table

Array = NDArray[np.float64]
PERIOD = 0.002  # s
SPEED = 1.8  # rad/s, fastest joint in the middle of a move
ACCELERATION = 14.0  # rad/s2, fastest joint
SHORTEST = 0.3  # s a move takes at least
REST = 0.45  # s at each pose: settle, then be measured


def move(start: Array, goal: Array) -> Array:
    """Return a quintic move (N, n) that begins after ``start`` and ends at ``goal``, at rest."""
    distance = float(np.abs(goal - start).max())
    duration = max(1.875 * distance / SPEED, np.sqrt(5.774 * distance / ACCELERATION), SHORTEST)
    s = np.linspace(0, 1, max(int(duration / PERIOD), 2) + 1)[1:, None]
    return np.asarray(start + (goal - start) * (10 * s**3 - 15 * s**4 + 6 * s**5))


def visits(home: Array, poses: Array, rest: float = REST) -> Array:
    """Return joints (N, n) at every period: from home through all poses, resting, and home."""
    still = int(rest / PERIOD)
    parts, here = [np.tile(home, (still, 1))], home
    for pose in (*poses, home):
        parts += [move(here, pose), np.tile(pose, (still, 1))]
        here = pose
    return np.vstack(parts)


def write_trajectory(path: Path, q: Array) -> float:
    """Write the trajectory's CSV; returns how long it takes, s."""
    t = np.arange(len(q)) * PERIOD
    names = ["timestamp", *(f"target_q_{i}" for i in range(q.shape[1]))]
    write_table(path, names, np.column_stack([t, q]))
    return float(t[-1])
