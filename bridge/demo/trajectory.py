"""The motion of one run: smooth moves from pose to pose, with a rest at each."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.setpoint_source.quintic import quintic, quintic_time
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
    fastest = np.minimum(SHARE * top_speed, FASTEST)
    duration = max(quintic_time(goal - start, fastest, ACCELERATION), SHORTEST)
    return quintic(start, goal, max(int(duration / PERIOD), 2))[1:]


def visits(home: Array, poses: Array, top_speed: Array, rest: float = REST) -> Array:
    """Return joints (N, n) at every period: from home through all poses, resting, and home."""
    still = int(rest / PERIOD)
    parts, here = [np.tile(home, (still, 1))], home
    for pose in poses:
        parts += [move(here, pose, top_speed), np.tile(pose, (still, 1))]
        here = pose
    return np.vstack([*parts, move(here, home, top_speed)])
