"""The motion from where the arm stands to the next pose: all joints together, slowly."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from gapbridge.bridge.document.output_file import write_table
from gapbridge.core.arrays import Array

PERIOD = 0.01  # s; between rows the daemon's source goes straight
ACCELERATION = 1.0  # rad/s2, fastest joint
SHORTEST = 0.5  # s
HOLD = 0.2  # s at the end


def move_between(begin: Array, end: Array, speed: float) -> Array:
    """Return joints (N, n) at every PERIOD of a quintic move at most ``speed`` rad/s fast."""
    distance = float(np.abs(end - begin).max())
    duration = max(1.875 * distance / speed, np.sqrt(5.774 * distance / ACCELERATION), SHORTEST)
    s = np.linspace(0, 1, int(np.ceil(duration / PERIOD)) + 1)[:, None]
    path = begin + (end - begin) * (10 * s**3 - 15 * s**4 + 6 * s**5)
    return np.asarray(np.vstack([path, np.tile(end, (int(HOLD / PERIOD), 1))]))


def write_move(path: Path, stops: Sequence[Array], speed: float) -> float:
    """Write the move from stop to stop, at rest in each, as the daemon's trajectory.

    Returns how long it takes, s.
    """
    q = np.vstack([move_between(begin, end, speed) for begin, end in pairwise(stops)])
    t = np.arange(len(q)) * PERIOD
    names = ["timestamp", *(f"target_q_{i}" for i in range(q.shape[1]))]
    write_table(path, names, np.column_stack([t, q]))
    return float(t[-1])
