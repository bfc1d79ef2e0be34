"""Cluster-robust covariance of the flexibilities, by a jackknife over poses.

The errors of one pose are correlated: joint errors (repeatability, encoder rounding) act on all six
coordinates through the Jacobian, and grow with the lever. So are those of neighbours in time in a
recording of motion.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.estimation.base_parameters import Identifiable
from gapbridge.core.estimation.compliance_fit import (
    Data,
    Fit,
    nuisance_columns,
    regressor,
    residual,
)
from gapbridge.core.estimation.held_out import jackknife, leave_one_out, pose_groups, random_folds
from gapbridge.core.estimation.least_squares import inverse
from gapbridge.core.estimation.robust import robust_weights, whitening_factors
from gapbridge.core.estimation.sampling import one_of_each_stretch

POSE_PARTS = 50  # groups of poses, left out in turn: determines a std to 10 %
MAX_ROWS = 2000  # used for the jackknife
MIN_PARTS_FACTOR = 2  # coordinates of groups over fitted parameters; with fewer: white noise


def error_groups(data: Data) -> Index:
    """Return the group (N,) of each row, with errors in common: its stretch of time, or pose."""
    return pose_groups(data.q) if data.stretch is None else data.stretch


def with_pose_scatter(fit: Fit, data: Data, shown: Identifiable, sigma: float) -> Identifiable:
    """Return the identifiability with the covariance (2n, 2n) by fits without groups of poses.

    Of many rows a sample gives its ratio to that of white noise. ``sigma`` (rad/Nm) is the prior's.
    Cameron, Miller, "A Practitioner's Guide to Cluster-Robust Inference" (2015), CV3.
    """
    kept, count = shown.kept, int(shown.kept.sum())
    sample = data.part(one_of_each_stretch(len(data.q), MAX_ROWS))
    A, b, prior = _rows(fit, sample, shown, sigma)
    A, b = A / shown.noise, b / shown.noise
    width = len(b) // len(sample.q)
    parts = random_folds(error_groups(sample), POSE_PARTS)
    if not count or (int(parts.max()) + 1) * width < MIN_PARTS_FACTOR * A.shape[1]:
        return shown
    flexible = np.arange(A.shape[1] - count, A.shape[1])
    white = inverse(A.T @ A + np.diag(prior**2))[np.ix_(flexible, flexible)]
    without = leave_one_out(np.vstack([A, np.diag(prior)]), np.concatenate([b, 0 * prior]),
                           np.repeat(parts, width))  # fmt: skip
    scatter = jackknife(np.array([x[flexible] for _, x in without]))
    white_root, covariance_root = (np.linalg.cholesky(C) for C in (
        white, shown.covariance[np.ix_(kept, kept)] / sigma**2,
    ))  # fmt: skip
    scaling = covariance_root @ np.linalg.inv(white_root)
    covariance = shown.covariance.copy()
    covariance[np.ix_(kept, kept)] = scaling @ scatter @ scaling.T * sigma**2
    return replace(shown, covariance=covariance)


def _rows(fit: Fit, data: Data, shown: Identifiable, sigma: float) -> tuple[Array, Array, Array]:
    """Return rows (m, p) of [geometry | nuisances | kept flexibilities], gap (m,) and ridge (p,).

    Rows are divided by the noise, flexibilities are in units of ``sigma``; the ridge is one over
    the prior sigma, 0 without one.
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
    cells = whitening_factors(weights, scale, width)
    A = np.concatenate(columns, axis=2) * cells[..., None]
    return A.reshape(gap.size, -1), (gap * cells).ravel(), np.concatenate(prior)
