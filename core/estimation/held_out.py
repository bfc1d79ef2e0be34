"""Cross-validation: folds, solutions with each fold left out, and the jackknife of those.

A pose's repeats and neighbours lie in one fold; regions of joint space hold out whole
neighbourhoods, so that nothing near a judged pose is in its fit.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.estimation.least_squares import SUMS_RANK, unit_of

FOLDS = 5
SAME_POSE = 1e-3  # rad, of every joint


def random_folds(groups: Index, count: int = FOLDS, seed: int = 0) -> Index:
    """Return the fold (N,) of each row, drawn at random; rows of one group (N,) stay together."""
    names, number = np.unique(groups, return_inverse=True)
    return np.asarray((np.random.default_rng(seed).permutation(len(names)) % count)[number])


def without_each(
    A: Array, b: Array, part: Index, hold: Array | None = None
) -> Iterator[tuple[Index, Array]]:
    """Yield each part's rows, and the x (p,) that solves A @ x = b best without them.

    ``part`` (<= m,) numbers the rows' parts; those after it are in every fit. ``hold`` (p,), one
    over a size, pulls each number towards zero.
    """
    unit = unit_of(A, hold)
    A = A * unit
    sums, right = A.T @ A, A.T @ b
    if hold is not None:
        sums += np.diag((hold * unit) ** 2)
    for name in np.unique(part):
        out = np.flatnonzero(part == name)
        own = A[out]
        inner = np.linalg.pinv(sums - own.T @ own, rcond=SUMS_RANK, hermitian=True)
        yield out, unit * (inner @ (right - own.T @ b[out]))


def missed(A: Array, b: Array, part: Index, hold: Array | None = None) -> Array:
    """Return b - A @ x (m,) of each row by the fit that its part (m,) was left out of."""
    left = np.empty_like(b)
    for out, x in without_each(A, b, part, hold):
        left[out] = b[out] - A[out] @ x
    return left


def jackknife(without: Array) -> Array:
    """Return the covariance (p, p) by fits (K, p) that left each of K parts out.

    Cameron, Miller, "A Practitioner's Guide to Cluster-Robust Inference" (2015), CV3.
    """
    away = without - without.mean(axis=0)
    return np.asarray((len(without) - 1) / len(without) * away.T @ away)


def pose_groups(q: Array) -> Index:
    """Return a number per row (N,): rows within SAME_POSE of each other share one."""
    groups = np.full(len(q), -1)
    count = 0
    for row in range(len(q)):
        if groups[row] < 0:
            close = (np.abs(q[row:] - q[row]).max(axis=1) < SAME_POSE) & (groups[row:] < 0)
            groups[row:][close] = count
            count += 1
    return groups


def joint_regions(q: Array, count: int, seed: int = 0) -> Index:
    """Return the region (N,) of each row of joint angles (N, n), rad: at most ``count`` of them.

    Repeats of a pose and its neighbours lie in one region.
    """
    distinct = len(np.unique(np.round(q, 3), axis=0))
    found = k_means(q, min(count, distinct), seed, rounds=50)
    return np.asarray(np.unique(found, return_inverse=True)[1].reshape(-1))


def k_means(points: Array, count: int, seed: int, rounds: int) -> Index:
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
