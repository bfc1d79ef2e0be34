"""The trajectory of one run: quintic moves from pose to pose, with a dwell at each."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.setpoint_source.quintic import quintic, quintic_time
from gapbridge.core.arrays import Array

PERIOD = 0.002  # s
SPEED_SHARE, MAX_SPEED = 0.9, 2.8  # peak of a move: share of the joint's limit, and rad/s
ACCELERATION = 14.0  # rad/s2, fastest joint
MIN_MOVE_TIME = 0.3  # s
DWELL = 0.4  # s at each pose, to settle and to be measured


def move(start: Array, goal: Array, top_speed: Array) -> Array:
    """Return a quintic move (N, n), rad, from ``start`` (excluded) to ``goal`` (n,), rest to rest.

    ``top_speed`` (n,): speed limits of the joints, rad/s.
    """
    fastest = np.minimum(SPEED_SHARE * top_speed, MAX_SPEED)
    duration = max(quintic_time(goal - start, fastest, ACCELERATION), MIN_MOVE_TIME)
    return quintic(start, goal, max(int(duration / PERIOD), 2))[1:]


def visit_trajectory(home: Array, poses: Array, top_speed: Array, dwell: float = DWELL) -> Array:
    """Return joint angles (N, n), rad, per PERIOD: home, a dwell at each pose (M, n), and home."""
    dwell_steps = int(dwell / PERIOD)
    parts, here = [np.tile(home, (dwell_steps, 1))], home
    for pose in poses:
        parts += [move(here, pose, top_speed), np.tile(pose, (dwell_steps, 1))]
        here = pose
    return np.vstack([*parts, move(here, home, top_speed)])
