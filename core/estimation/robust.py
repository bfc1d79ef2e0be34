"""Robust estimation: noise scale, outlier weights, starting weights, and a fit by them.

Distances are root mean squares over a reading's cells, in units of their noise. From ``FULL`` on a
reading counts less, from ``OUTLIER`` on nothing (Tukey's biweight; Beaton, Tukey, Technometrics 16
(1974) 147). Such a weight stays where a bad start leaves it: of 70 points of which a third are off
alike, a frame begun at least squares keeps 0.35 of their error, with a scale by the same residuals.
``start_weights`` (Cauchy's) fall slowly enough to come away, of two in five as well, but never to
zero: they are where a fit begins, never what it ends with.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.estimation.least_squares import inverse, solve

STARTING, ROUNDS = 12, 60
CONVERGED = 1e-9  # change of the weights at which the fit has converged
FULL = 2.0  # distance up to which a reading counts wholly: clean data keep their information
OUTLIER = 5.0  # distance from which a reading counts for nothing
START = 1.35  # distance of half a starting weight. At 1 the centre of a touched sphere stays where
# outliers put it, at 2.4 (Cauchy's 95 % efficiency) two in five that are off alike are not left
NORMAL = 1.4826  # 1 sigma over the median of absolute values, of a normal distribution
TINY = 1e-12


@dataclass(frozen=True)
class RobustFit:
    """State of a weighted fit that has converged."""

    values: Array  # (p,)
    covariance: Array  # (p, p)
    noise: Array  # (units,) 1 sigma of one cell
    freedom: float  # degrees of freedom left
    weights: Array  # (rows,) 0: outlier, 1: inlier
    outliers: Index  # rows of weight zero


def scale_of(residual: Array) -> float:
    """Return the noise of residuals (1 sigma) by their median, which outliers do not move."""
    return max(NORMAL * float(np.median(np.abs(residual))), TINY)


def distance_of(residual: Array, scale: Array | float) -> Array:
    """Return the distances (N,) of residuals (N, k) where the noise is ``scale``, or (k,)."""
    return np.asarray(np.sqrt(np.mean((residual / scale) ** 2, axis=1)))


def weights_of(distance: Array) -> Array:
    """Return weights for distances: 1 up to FULL, falling to 0 at OUTLIER."""
    fall = np.clip((distance - FULL) / (OUTLIER - FULL), 0.0, 1.0)
    return np.asarray((1 - fall**2) ** 2)


def start_weights(residual: Array) -> Array:
    """Return weights (N,) of residuals (N, k) in one unit, with which a fit may begin."""
    return start_weights_of(distance_of(residual, scale_of(residual)))


def start_weights_of(distance: Array, half: float = START) -> Array:
    """Return the same for distances (N,); at ``half`` the weight is one half."""
    return np.asarray(1 / (1 + (distance / half) ** 2))


def robust_fit(A: Array, b: Array, unit: Index, row: Index, rounds: int = ROUNDS) -> RobustFit:
    """Return the robust fit of A (M, p) @ values = b (M,).

    ``unit`` (M,) numbers cells that share one unknown noise, ``row`` (M,) the reading that a cell
    belongs to: outliers are down-weighted as wholes.
    """
    rows, units = int(row.max()) + 1, int(unit.max()) + 1
    cells: Array = np.bincount(row, minlength=rows).astype(np.float64)
    weights, spare = np.ones(rows), np.ones(units)
    noise = np.array([max(float(np.std(b[unit == u])), TINY) for u in range(units)])
    # of few cells the fit takes up much of the noise
    left_over = np.sqrt(max(1 - A.shape[1] / len(b), 0.1))
    for turn in range(STARTING + rounds):
        before, root = weights, np.sqrt(weights[row]) / noise[unit]
        values = solve(A * root[:, None], b * root)
        left, starting = b - A @ values, turn < STARTING
        if starting:
            noise = np.array([scale_of(left[unit == u]) for u in range(units)]) / left_over
        else:
            noise, spare = _noise(A, left, root, weights[row], unit, units)
        distance = np.sqrt(np.bincount(row, (left / noise[unit]) ** 2, rows) / cells)
        weights = start_weights_of(distance) if starting else weights_of(distance)
        if not starting and np.abs(weights - before).max() < CONVERGED:
            break
    root = np.sqrt(weights[row]) / noise[unit]
    scaled = A * root[:, None]
    covariance = inverse(scaled.T @ scaled)
    # the unit that is known from the fewest cells says how sure the noise is
    freedom = max(float(spare.min()), 1.0)
    return RobustFit(values, covariance, noise, freedom, weights, np.flatnonzero(weights == 0))


def _noise(
    A: Array, left: Array, root: Array, weight: Array, unit: Index, units: int
) -> tuple[Array, Array]:  # fmt: skip
    """Return 1 sigma of each unit's cells, and the degrees of freedom that the fit leaves them."""
    Q = np.linalg.qr(A * root[:, None])[0]
    spare = weight - np.einsum("ij,ij->i", Q, Q)
    freedom = np.maximum(np.bincount(unit, spare, units), 0.5)
    return np.maximum(np.sqrt(np.bincount(unit, weight * left**2, units) / freedom), TINY), freedom
