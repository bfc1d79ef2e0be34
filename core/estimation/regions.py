"""Regions of joint space: folds that hold out whole neighbourhoods, not single poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def joint_regions(q: Array, count: int, seed: int = 0) -> NDArray[np.int64]:
    """Return the region (N,) of each row of joint angles (N, n), rad: at most ``count`` of them.

    k-means in joint space (Lloyd 1982; first centres by k-means++), so repeats of a pose and its
    neighbours lie in one region.
    """
    from scipy.cluster.vq import kmeans2  # a quarter of a second, only where it is asked for

    distinct = len(np.unique(np.round(q, 3), axis=0))
    found = kmeans2(q, min(count, distinct), minit="++", seed=seed, iter=50)[1]
    return np.asarray(np.unique(found, return_inverse=True)[1].reshape(-1))
