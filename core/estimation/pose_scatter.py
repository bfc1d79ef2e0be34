"""How surely flexibilities are known: by fits that left poses out.

The errors of one pose are not independent: those of its joints (repeatability, rounding of the
encoders) reach all six coordinates through the Jacobian, and are larger where the lever is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.estimation.base_parameters import Identifiable
from gapbridge.core.estimation.compliance_fit import (
    Data,
    Fit,
    nuisance_columns,
    per_cell_of,
    regressor,
    residual,
    robust_weights,
)
from gapbridge.core.estimation.held_out import jackknife, pose_groups, random_folds, without_each
from gapbridge.core.estimation.least_squares import inverse

PARTS = 50  # parts of the poses, left out in turn: a standard deviation to a tenth of itself
ROWS = 2000  # rows that show how errors scatter; more cost time and add hardly anything
FEWEST = 2  # times as many coordinates of parts as numbers fitted; of fewer poses noise is white


def by_poses(fit: Fit, data: Data, shown: Identifiable, sigma: float) -> Identifiable:
    """Return what is shown, with the covariance (2n, 2n) by fits that left poses out in turn.

    Of many rows some say by how much it differs from that of white noise. ``sigma`` (rad/Nm) is the
    prior's. Cameron, Miller, "A Practitioner's Guide to Cluster-Robust Inference" (2015), CV3.
    """
    kept, count = shown.kept, int(shown.kept.sum())
    some = data.part(slice(None, None, -(-len(data.q) // ROWS)))
    A, b, prior = _rows(fit, some, shown, sigma)
    width = len(b) // len(some.q)
    part = random_folds(pose_groups(some.q), PARTS)
    if not count or (int(part.max()) + 1) * width < FEWEST * A.shape[1]:
        return shown
    own = np.arange(A.shape[1] - count, A.shape[1])
    white = inverse(A.T @ A + np.diag(prior**2))[np.ix_(own, own)]
    without = without_each(np.vstack([A, np.diag(prior)]), np.concatenate([b, 0 * prior]),
                           np.repeat(part, width))  # fmt: skip
    scatter = jackknife(np.array([x[own] for _, x in without]))
    root, whole = (np.linalg.cholesky(C) for C in (
        white, shown.covariance[np.ix_(kept, kept)] / sigma**2,
    ))  # fmt: skip
    change = whole @ np.linalg.inv(root)
    covariance = shown.covariance.copy()
    covariance[np.ix_(kept, kept)] = change @ scatter @ change.T * sigma**2
    return replace(shown, covariance=covariance)


def _rows(fit: Fit, data: Data, shown: Identifiable, sigma: float) -> tuple[Array, Array, Array]:
    """Return the rows (m, p) of [geometry | nuisances | kept flexibilities], the gap (m,) they see.

    Everything is in units of the noise, the flexibilities in ``sigma``; last comes one over the
    prior 1 sigma (p,) of each number, 0 of one that is free.
    """
    gap, poses = residual(fit.model, data, fit.frame)
    weights, scale = robust_weights(gap)
    width = gap.shape[1]
    columns = [regressor(fit.model, data, fit.frame)[:, :width][:, :, shown.kept] * sigma]
    prior = [np.ones(int(shown.kept.sum()))]
    if data.nuisances:
        columns.insert(0, nuisance_columns(fit.model, poses, width, data))
        prior.insert(0, np.zeros(data.nuisances))
    if fit.geometry is not None:
        columns.insert(0, fit.geometry.columns(fit.model, data.q, data.loads, width))
        prior.insert(0, 1 / fit.geometry.sigma)
    cells = per_cell_of(weights, scale, width)
    A = np.concatenate(columns, axis=2) * cells[..., None]
    return A.reshape(gap.size, -1), (gap * cells).ravel(), np.concatenate(prior)
