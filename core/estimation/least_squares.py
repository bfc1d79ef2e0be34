"""Linear least squares: with a prior, within bounds, and with nuisance columns projected out.

Columns are scaled to one length before anything is decomposed, so that metres, radians and
flexibilities have one meaning of rank. A prior is rows of its own.
"""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array, Mask

RANK = 1e-9  # singular value of unit columns below which a direction is rounding
SUMS_RANK = 1e-13  # the same of an eigenvalue of their sums of products
DEPENDENT = 1e-6  # the same of columns that say the same for every purpose
OPTIMAL = 1e-14  # share of a product that is no gradient


def unit_of(columns: Array, hold: Array | None = None) -> Array:
    """Return one over the length of each column (p,), with what holds it; 0 of an empty one."""
    square = np.einsum("ij,ij->j", columns, columns)
    size = np.sqrt(square if hold is None else square + hold**2)
    return _inverted(size)


def _inverted(size: Array) -> Array:
    """Return one over sizes (p,), 0 where there is nothing."""
    return np.where(size > 1e-150, 1 / np.maximum(size, 1e-150), 0.0)


def solve(A: Array, b: Array, hold: Array | None = None, rank: float = RANK) -> Array:
    """Return the x (p,) that solves A @ x = b best; of what the rows do not show the least.

    ``hold`` (<= p,), one over a size, pulls the first numbers towards zero.
    """
    if not A.shape[1]:
        return np.zeros(0)
    pull = np.zeros(A.shape[1])
    if hold is not None:
        pull[: len(hold)] = hold
    unit = unit_of(A, pull)
    if pull.any():
        held = np.flatnonzero(pull)
        prior = np.zeros((len(held), len(pull)))
        prior[np.arange(len(held)), held] = pull[held]
        A, b = np.vstack([A, prior]), np.concatenate([b, np.zeros(len(held))])
    return np.asarray(np.linalg.lstsq(A * unit, b, rcond=rank)[0] * unit)


def inverse(sums: Array, rank: float = SUMS_RANK) -> Array:
    """Return the inverse (p, p) of sums of products A^T A: the covariance under unit noise.

    Zero along what the rows do not show.
    """
    unit = _inverted(np.sqrt(np.maximum(np.diag(sums), 0.0)))
    scaled = np.outer(unit, unit)
    return np.asarray(np.linalg.pinv(sums * scaled, rcond=rank, hermitian=True) * scaled)


def sigmas_square(values: Array, covariance: Array) -> float:
    """Return the squared distance of values (p,) from zero, in sigmas of their covariance."""
    if len(values) == 1:  # most are; a decomposition of one number costs 0.1 ms
        variance = float(covariance[0, 0])
        return float(values[0] ** 2 / variance) if variance else 0.0
    return float(values @ np.linalg.pinv(covariance, hermitian=True) @ values)


def bounded(A: Array, b: Array, lower: Array, upper: Array) -> tuple[Array, Mask]:
    """Return the x (p,) within bounds that solves A @ x = b best, and which stand on a bound (p,).

    Active sets with release: ends where the conditions of an optimum hold (Stark, Parker,
    "Bounded-Variable Least-Squares", Computational Statistics 10 (1995) 129).
    """
    unit, ends = unit_of(A), (lower, upper)
    A, lower, upper = A * unit, *(_scaled(end, unit) for end in ends)
    x = np.linalg.lstsq(A, b, rcond=None)[0]
    stuck = (x < lower) | (x > upper)
    x = np.clip(x, lower, upper)
    for _ in range(10 * len(x) + 10):
        free = ~stuck
        best = x.copy()
        if free.any():
            best[free] = np.linalg.lstsq(A[:, free], b - A[:, stuck] @ x[stuck], rcond=None)[0]
        out = free & ((best < lower) | (best > upper))
        if out.any():  # up to the first bound on the way
            end = np.where(best < lower, lower, upper)
            share = np.full(len(x), np.inf)
            share[out] = (end[out] - x[out]) / (best[out] - x[out])
            first = int(np.argmin(share))
            x = np.clip(x + share[first] * (best - x), lower, upper)
            x[first], stuck[first] = end[first], True
            continue
        x = best
        gain = A.T @ (b - A @ x)
        inward = np.where(x <= lower, gain, -gain) * stuck
        first = int(np.argmax(inward))
        if inward[first] <= OPTIMAL * np.linalg.norm(b):
            break
        stuck[first] = False
    return np.clip(x * unit, *ends), stuck


def _scaled(end: Array, unit: Array) -> Array:
    """Return bounds of numbers (p,) for those of unit columns; an empty column has none."""
    return np.asarray(np.where(unit > 0, end / np.where(unit > 0, unit, 1.0), end))


def basis_of(columns: Array, rank: float = DEPENDENT) -> Array:
    """Return an orthonormal basis of columns (m, r), nearly dependent ones left out."""
    if not columns.shape[1]:
        return columns
    U, s, _ = np.linalg.svd(columns * unit_of(columns), full_matrices=False)
    return np.asarray(U[:, s > rank * max(float(s[0]), 1e-300)])


def projected_out(basis: Array, columns: Array) -> Array:
    """Return columns (m, ...) less what an orthonormal basis (m, r) holds of them."""
    return np.asarray(columns - basis @ (basis.T @ columns))
