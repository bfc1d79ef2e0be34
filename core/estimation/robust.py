"""Least squares that a few outliers cannot spoil, noise estimated along, per unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
ROUNDS = 60
CONVERGED = 1e-9  # change of the weights at which the fit has converged
INLIER = 2.2  # scaled length below which nothing is down-weighted
OUTLIER = 4.5  # scaled length beyond which a reading counts for nothing
TINY = 1e-12


@dataclass(frozen=True)
class RobustFit:
    """State of a weighted fit that has converged."""

    values: Array  # (p,)
    covariance: Array  # (p, p)
    noise: Array  # (units,) 1 sigma of one cell
    freedom: float  # degrees of freedom left
    weights: Array  # (rows,) 0: outlier, 1: inlier
    outliers: Index  # rows of weight zero, or nearly


def weights_of(length: Array) -> Array:
    """Return weights for scaled lengths: 1 up to INLIER, falling to 0 at OUTLIER."""
    fall = np.clip((length - INLIER) / (OUTLIER - INLIER), 0.0, 1.0)
    return np.asarray((1 - fall**2) ** 2)


def scaled_length(square: Array, cells: Array) -> Array:
    """Return lengths that compare readings of different width: an inlier's is around one.

    ``square`` is a reading's sum of squares over the noise, ``cells`` its number of cells
    (Wilson and Hilferty's cube root, so that one limit means the same chance for any width).
    """
    spread = 2.0 / (9.0 * cells)
    normal = (np.cbrt(square / cells) - (1 - spread)) / np.sqrt(spread)
    return np.asarray(np.maximum(normal, 0.0))


def robust_fit(A: Array, b: Array, unit: Index, row: Index, rounds: int = ROUNDS) -> RobustFit:
    """Return the robust fit of A (M, p) @ values = b (M,).

    ``unit`` (M,) numbers cells that share one unknown noise, ``row`` (M,) the reading that a cell
    belongs to: outliers are down-weighted as wholes. Starts from a fit of least absolute
    deviations, so that a large minority of outliers is seen.
    """
    rows, units = int(row.max()) + 1, int(unit.max()) + 1
    cells: Array = np.bincount(row, minlength=rows).astype(np.float64)
    weights, spare = np.ones(rows), np.ones(units)
    values, noise = _begin(A, b, unit, units)
    for _ in range(rounds):
        before = weights
        left = (b - A @ values) / noise[unit]
        weights = weights_of(
            scaled_length(np.asarray(np.bincount(row, left**2, rows), float), cells)
        )
        root = np.sqrt(weights[row]) / noise[unit]
        values = np.asarray(np.linalg.lstsq(A * root[:, None], b * root, rcond=None)[0], float)
        noise, spare = _noise(A, b - A @ values, root, weights[row], unit, units)
        if np.abs(weights - before).max() < CONVERGED:
            break
    root = np.sqrt(weights[row]) / noise[unit]
    scaled = A * root[:, None]
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-15, hermitian=True)
    covariance = np.asarray(inverse, float)
    # the unit that is known from the fewest cells says how sure the noise is
    freedom = max(float(spare.min()), 1.0)
    return RobustFit(values, covariance, noise, freedom, weights, np.flatnonzero(weights < 0.1))


def _begin(A: Array, b: Array, unit: Index, units: int) -> tuple[Array, Array]:
    """Return values of about least absolute deviations, and the noise of each unit."""
    size = np.array([max(float(np.std(b[unit == u])), TINY) for u in range(units)])
    values = np.linalg.lstsq(A / size[unit, None], b / size[unit], rcond=None)[0]
    for _ in range(20):
        left = np.abs(b - A @ values)
        typical = np.array([max(float(np.median(left[unit == u])), TINY) for u in range(units)])
        root = 1 / np.sqrt(np.maximum(left, 0.1 * typical[unit]) * typical[unit])
        values = np.linalg.lstsq(A * root[:, None], b * root, rcond=None)[0]
    left = np.abs(b - A @ values)
    # absolute deviations meet as many cells exactly as there are numbers: these show no noise
    shows = np.ones(len(b), dtype=bool)
    shows[np.argsort(left / size[unit])[: A.shape[1]]] = False
    noise = []
    for u in range(units):
        own = unit == u
        cells = left[own & shows] if (own & shows).any() else left[own]
        noise.append(max(1.4826 * float(np.median(cells)), TINY))
    return values, np.array(noise)


def _noise(
    A: Array, left: Array, root: Array, weight: Array, unit: Index, units: int
) -> tuple[Array, Array]:  # fmt: skip
    """Return 1 sigma of each unit's cells, and the degrees of freedom that the fit leaves them."""
    Q = np.linalg.qr(A * root[:, None])[0]
    spare = weight - np.einsum("ij,ij->i", Q, Q)
    freedom = np.maximum(np.bincount(unit, spare, units), 0.5)
    return np.maximum(np.sqrt(np.bincount(unit, weight * left**2, units) / freedom), TINY), freedom
