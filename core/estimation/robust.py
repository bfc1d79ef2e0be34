"""Robust estimation: noise scale, outlier weights, starting weights, and a robust fit.

Distances are root mean squares over a reading's equations, in units of their noise. The final
weights are Tukey's biweight (Beaton, Tukey, Technometrics 16 (1974) 147): one up to
``FULL_WEIGHT``, zero from ``OUTLIER`` on. It redescends and needs a good start: with a third of 70
points off by the same vector, a frame started at least squares keeps 0.35 of their error.
``start_weights`` (Cauchy's) converge from least squares with two outliers in five, but are never
zero: use them to start a fit only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.estimation.least_squares import inverse, solve

START_ROUNDS, ROUNDS = 12, 60
CONVERGED = 1e-9  # change of the weights at which the fit has converged
FULL_WEIGHT = 2.0  # largest distance with weight one
OUTLIER = 5.0  # smallest distance with weight zero
HALF_WEIGHT = 1.35  # distance with a starting weight of one half; at 1 a touched sphere's centre
# stays at outliers, at 2.4 (95 % efficiency) two equal outliers in five are not rejected
MAD_TO_SIGMA = 1.4826  # 1 sigma over the median of absolute values, of a normal distribution
TINY = 1e-12


@dataclass(frozen=True)
class RobustFit:
    """State of a weighted fit that has converged."""

    values: Array  # (p,)
    covariance: Array  # (p, p)
    noise: Array  # (units,) 1 sigma of one equation
    freedom: float  # degrees of freedom left
    weights: Array  # (rows,) 0: outlier, 1: inlier
    outliers: Index  # rows of weight zero


def scale_of(residual: Array) -> float:
    """Return the noise of residuals (1 sigma) by their median absolute value."""
    return max(MAD_TO_SIGMA * float(np.median(np.abs(residual))), TINY)


def distance_of(residual: Array, scale: Array | float) -> Array:
    """Return the distances (N,) of residuals (N, k) where the noise is ``scale``, or (k,)."""
    return np.asarray(np.sqrt(np.mean((residual / scale) ** 2, axis=1)))


def weights_of(distance: Array) -> Array:
    """Return weights for distances: 1 up to FULL, falling to 0 at OUTLIER."""
    fall = np.clip((distance - FULL_WEIGHT) / (OUTLIER - FULL_WEIGHT), 0.0, 1.0)
    return np.asarray((1 - fall**2) ** 2)


def start_weights(residual: Array) -> Array:
    """Return starting weights (N,) of residuals (N, k) in one unit."""
    return start_weights_of(distance_of(residual, scale_of(residual)))


def start_weights_of(distance: Array, half: float = HALF_WEIGHT) -> Array:
    """Return starting weights for distances (N,); at ``half`` the weight is one half."""
    return np.asarray(1 / (1 + (distance / half) ** 2))


def robust_fit(A: Array, b: Array, unit: Index, row: Index, rounds: int = ROUNDS) -> RobustFit:
    """Return the robust fit of A (M, p) @ values = b (M,).

    ``unit`` (M,) numbers equations that share one unknown noise, ``row`` (M,) the reading of each
    equation: whole readings are down-weighted.
    """
    rows, units = int(row.max()) + 1, int(unit.max()) + 1
    cells: Array = np.bincount(row, minlength=rows).astype(np.float64)
    weights, spare = np.ones(rows), np.ones(units)
    noise = np.array([max(float(np.std(b[unit == u])), TINY) for u in range(units)])
    # correct the noise for the fitted parameters
    noise_share = np.sqrt(max(1 - A.shape[1] / len(b), 0.1))
    for iteration in range(START_ROUNDS + rounds):
        before, root = weights, np.sqrt(weights[row]) / noise[unit]
        values = solve(A * root[:, None], b * root)
        left, starting = b - A @ values, iteration < START_ROUNDS
        if starting:
            noise = np.array([scale_of(left[unit == u]) for u in range(units)]) / noise_share
        else:
            noise, spare = _noise(A, left, root, weights[row], unit, units)
        distance = np.sqrt(np.bincount(row, (left / noise[unit]) ** 2, rows) / cells)
        weights = start_weights_of(distance) if starting else weights_of(distance)
        if not starting and np.abs(weights - before).max() < CONVERGED:
            break
    root = np.sqrt(weights[row]) / noise[unit]
    scaled = A * root[:, None]
    covariance = inverse(scaled.T @ scaled)
    # the unit with the fewest degrees of freedom
    freedom = max(float(spare.min()), 1.0)
    return RobustFit(values, covariance, noise, freedom, weights, np.flatnonzero(weights == 0))


def _noise(
    A: Array, left: Array, root: Array, weight: Array, unit: Index, units: int
) -> tuple[Array, Array]:  # fmt: skip
    """Return 1 sigma of each unit's equations, and their residual degrees of freedom."""
    Q = np.linalg.qr(A * root[:, None])[0]
    spare = weight - np.einsum("ij,ij->i", Q, Q)
    freedom = np.maximum(np.bincount(unit, spare, units), 0.5)
    return np.maximum(np.sqrt(np.bincount(unit, weight * left**2, units) / freedom), TINY), freedom


# -- gaps of poses, in m and rad -------------------------------------------------------------------


def whitening_factors(weights: Array, scale: Array, width: int) -> Array:
    """Return the factor (N, width) of each equation: root of the weight over the noise."""
    return np.asarray(np.sqrt(weights)[:, None] / np.repeat(scale, 3)[:width])


def robust_weights(gap: Array) -> tuple[Array, Array]:
    """Return the weights (N,) of gaps (N, 3 or 6), and their noise (2,), m and rad."""
    scale = noise_of(gap)
    return weights_at(gap, scale), scale


def noise_of(gap: Array) -> Array:
    """Return the noise (2,), m and rad, of gaps (N, 3 or 6).

    At least a third of the rows are inliers with it: of a gap in one direction only (a base whose
    height is wrong) the median coordinate shows nothing.
    """
    scale = np.array([scale_of(gap[:, :3]), scale_of(gap[:, 3:]) if gap.shape[1] > 3 else 1.0])
    distance = distance_of(gap, np.repeat(scale, 3)[: gap.shape[1]])
    return np.asarray(scale * max(float(np.quantile(distance, 1 / 3)) / FULL_WEIGHT, 1.0))


def weights_at(gap: Array, scale: Array) -> Array:
    """Return the weights (N,) of gaps (N, 3 or 6) where the noise is ``scale`` (2,)."""
    return weights_of(distance_of(gap, np.repeat(scale, 3)[: gap.shape[1]]))
