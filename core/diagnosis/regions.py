"""Parts of a log for cross-validation: regions of joint space, or stretches of time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.diagnosis.channels.recording import STRETCHES
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.estimation.held_out import k_means, random_folds

SAME_POSE = 0.01  # rad: range of every joint below which a log has a single pose
REGIONS = 24  # of joint space
PARTS = 8  # held out in turn, each of several scattered regions


def parts(observation: Observation, kept: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the part (n,) of each kept sample.

    Holding out one large region would mean extrapolation. With scattered regions it does less, and
    still no neighbour of a held-out pose is in its fit.
    """
    region = regions(observation, kept)
    if observation.order_in_time:
        return np.asarray(region % PARTS)
    return random_folds(region, PARTS)


def single_pose(observation: Observation) -> bool:
    """Return whether a channel has a single pose and load, so that no region is a new one."""
    return not any(
        name.startswith(("payload", "actual_TCP_force", "session"))
        or (name.startswith(("actual_q_", "target_q_")) and np.ptp(values) > SAME_POSE)
        for name, values in observation.quantities.items()
    )


def regions(observation: Observation, kept: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the region of joint space, or stretch of time, (n,) of each kept sample.

    Pauses of a recording are no part of a stretch. Positions in motion have few and long ones:
    their errors may be correlated over much of a slow motion (of 6 s, over 0.2 s: 24 stretches
    cover 81 % instead of 95, 8 92 %).
    """
    if observation.order_in_time:
        stretch = observation.groups[kept]
        return stretch // (STRETCHES // PARTS) if observation.channel == "position" else stretch
    conditions = np.unique(observation.groups[kept], return_inverse=True)[1].reshape(-1)
    names = [q for q in observation.quantities if q.startswith(("actual_q_", "target_q_"))]
    if not names:
        return np.asarray(conditions)
    poses = np.stack([observation.quantities[q][kept] for q in names], axis=1)
    count = min(REGIONS, max(4, (int(conditions.max()) + 1) // 3))
    region = k_means(poses, count, seed=0, rounds=30)
    return np.asarray(np.unique(region, return_inverse=True)[1].reshape(-1))
