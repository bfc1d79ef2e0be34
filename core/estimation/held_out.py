"""Cross-validation: folds, solutions with each fold left out, and the jackknife of those.

Repeats of a pose are in one fold. Regions of joint space leave out whole neighbourhoods, so that no
neighbour of a tested pose is in its fit.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.estimation.least_squares import SUMS_RANK, inverse_lengths

FOLDS = 5
SAME_POSE = 1e-3  # rad, of every joint
MAX_COMPARED = 3000  # rows that are compared with each other


def random_folds(groups: Index, count: int = FOLDS, seed: int = 0) -> Index:
    """Return the fold (N,) of each row, drawn at random; rows of one group (N,) stay together."""
    labels, number = np.unique(groups, return_inverse=True)
    return np.asarray((np.random.default_rng(seed).permutation(len(labels)) % count)[number])


def leave_one_out(
    A: Array, b: Array, fold: Index, ridge: Array | None = None
) -> Iterator[tuple[Index, Array]]:
    """Yield each fold's rows, and the least-squares x (p,) of A @ x = b without them.

    ``fold`` (<= m,) is the fold of each row; further rows are in every fit. ``ridge`` (p,) is one
    over the prior sigma of each number about zero.
    """
    unit = inverse_lengths(A, ridge)
    A = A * unit
    sums, right = A.T @ A, A.T @ b
    if ridge is not None:
        sums += np.diag((ridge * unit) ** 2)
    for name in np.unique(fold):
        rows = np.flatnonzero(fold == name)
        own = A[rows]
        inner = np.linalg.pinv(sums - own.T @ own, rcond=SUMS_RANK, hermitian=True)
        yield rows, unit * (inner @ (right - own.T @ b[rows]))


def held_out_residual(A: Array, b: Array, fold: Index, ridge: Array | None = None) -> Array:
    """Return b - A @ x (m,) of each row by the fit without its fold (m,)."""
    residual = np.empty_like(b)
    for rows, x in leave_one_out(A, b, fold, ridge):
        residual[rows] = b[rows] - A[rows] @ x
    return residual


def jackknife(without: Array) -> Array:
    """Return the covariance (p, p) by fits (K, p) without each of K folds.

    Cameron, Miller, "A Practitioner's Guide to Cluster-Robust Inference" (2015), CV3.
    """
    deviation = without - without.mean(axis=0)
    return np.asarray((len(without) - 1) / len(without) * deviation.T @ deviation)


def pose_groups(q: Array) -> Index:
    """Return a number per row (N,): rows within SAME_POSE of each other share one.

    Of many rows those that round to the same pose share one, for speed; equal poses on either side
    of a rounding limit then have two.
    """
    if len(q) > MAX_COMPARED:
        rounded = np.round(q / SAME_POSE)
        return np.asarray(np.unique(rounded, axis=0, return_inverse=True)[1].reshape(-1))
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
    clusters = k_means(q, min(count, distinct), seed, rounds=50)
    return np.asarray(np.unique(clusters, return_inverse=True)[1].reshape(-1))


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
            total_distance = nearest.sum()
            if total_distance == 0.0:  # fewer distinct points than centres
                centres[i:] = points[0]
                break
            share = nearest / total_distance
            chosen = int(np.searchsorted(share.cumsum(), rng.uniform()))
        centres[i] = points[chosen]
        nearest = np.minimum(nearest, np.sum((points - centres[i]) ** 2, axis=1))
    for _ in range(rounds):
        distance = np.sum(centres**2, axis=1) - 2.0 * points @ centres.T  # without |point|^2
        label = np.argmin(distance, axis=1)
        members = np.bincount(label, minlength=count)
        occupied = members > 0
        for j in range(points.shape[1]):
            total = np.bincount(label, weights=points[:, j], minlength=count)
            centres[occupied, j] = total[occupied] / members[occupied]
    return np.asarray(label)
