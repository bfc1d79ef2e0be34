"""The motion of one run: smooth moves from pose to pose, with a rest at each."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gapbridge.bridge.document.output_file import write_table
from gapbridge.core.arrays import Array

PERIOD = 0.002  # s
SHARE, FASTEST = 0.9, 2.8  # of each joint's top speed, and rad/s: in the middle of a move
ACCELERATION = 14.0  # rad/s2, fastest joint
SHORTEST = 0.3  # s a move takes at least
REST = 0.4  # s at each pose: settle, then be measured


def move(start: Array, goal: Array, top_speed: Array) -> Array:
    """Return a quintic move (N, n) that begins after ``start`` and ends at ``goal``, at rest.

    ``top_speed`` (n,) is what the joints may do, rad/s.
    """
    distance = np.abs(goal - start)
    shortest = float((distance / np.minimum(SHARE * top_speed, FASTEST)).max())
    duration = max(1.875 * shortest, np.sqrt(5.774 * distance.max() / ACCELERATION), SHORTEST)
    s = np.linspace(0, 1, max(int(duration / PERIOD), 2) + 1)[1:, None]
    return np.asarray(start + (goal - start) * (10 * s**3 - 15 * s**4 + 6 * s**5))


def visits(home: Array, poses: Array, top_speed: Array, rest: float = REST) -> Array:
    """Return joints (N, n) at every period: from home through all poses, resting, and home."""
    still = int(rest / PERIOD)
    parts, here = [np.tile(home, (still, 1))], home
    for pose in (*poses, home):
        parts += [move(here, pose, top_speed), np.tile(pose, (still, 1))]
        here = pose
    return np.vstack(parts)


def write_trajectory(path: Path, q: Array) -> float:
    """Write the trajectory's CSV; returns how long it takes, s."""
    t = np.arange(len(q)) * PERIOD
    names = ["timestamp", *(f"target_q_{i}" for i in range(q.shape[1]))]
    write_table(path, names, np.column_stack([t, q]))
    return float(t[-1])
