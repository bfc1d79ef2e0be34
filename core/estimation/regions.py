"""Regions of joint space: folds that hold out whole neighbourhoods, not single poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def joint_regions(q: Array, count: int, seed: int = 0) -> NDArray[np.int64]:
    """Return the region (N,) of each row of joint angles (N, n), rad: at most ``count`` of them.

    Repeats of a pose and its neighbours lie in one region.
    """
    distinct = len(np.unique(np.round(q, 3), axis=0))
    found = k_means(q, min(count, distinct), seed, rounds=50)
    return np.asarray(np.unique(found, return_inverse=True)[1].reshape(-1))


def k_means(points: Array, count: int, seed: int, rounds: int) -> NDArray[np.int64]:
    """Return the cluster (N,), 0..count-1, of each of the points (N, n); some may stay empty.

    Lloyd's iterations (1982) from centres by k-means++ (Arthur, Vassilvitskii 2007), with the
    draws of scipy.cluster.vq.kmeans2, which takes a fifth of a second to import.
    """
    rng = np.random.RandomState(seed)
    centres, nearest = np.empty((count, points.shape[1])), np.full(len(points), np.inf)
    chosen = int(rng.randint(len(points), dtype=np.int64))
    for i in range(count):
        if i > 0:
            whole = nearest.sum()
            if whole == 0.0:  # fewer places than centres
                centres[i:] = points[0]
                break
            share = nearest / whole
            chosen = int(np.searchsorted(share.cumsum(), rng.uniform()))
        centres[i] = points[chosen]
        nearest = np.minimum(nearest, np.sum((points - centres[i]) ** 2, axis=1))
    for _ in range(rounds):
        distance = np.sum(centres**2, axis=1) - 2.0 * points @ centres.T  # beside a point's own
        label = np.argmin(distance, axis=1)
        held = np.bincount(label, minlength=count)
        some = held > 0
        for j in range(points.shape[1]):
            total = np.bincount(label, weights=points[:, j], minlength=count)
            centres[some, j] = total[some] / held[some]
    return np.asarray(label)
