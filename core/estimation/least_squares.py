"""Linear least squares: with a prior, within bounds, and with nuisance columns projected out.

Columns are scaled to unit length before a decomposition, so that rank does not depend on units. A
prior is a set of further rows.
"""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array, Mask

RANK = 1e-9  # singular value of unit columns below which a direction is rounding
SUMS_RANK = 1e-13  # the same of an eigenvalue of their sums of products
DEPENDENT = 1e-6  # the same of columns that count as dependent
OPTIMAL = 1e-14  # relative gradient of an optimum


def inverse_lengths(columns: Array, ridge: Array | None = None) -> Array:
    """Return one over the length of each column (p,), its ridge included; 0 of an empty one."""
    square = np.einsum("ij,ij->j", columns, columns)
    size = np.sqrt(square if ridge is None else square + ridge**2)
    return _inverted(size)


def unit_columns(columns: Array) -> Array:
    """Return columns (m, p) of unit length; zero ones stay zero."""
    return np.asarray(columns / (np.sqrt(np.einsum("ij,ij->j", columns, columns)) + 1e-300))


def _inverted(size: Array) -> Array:
    """Return one over sizes (p,), 0 of a zero."""
    return np.where(size > 1e-150, 1 / np.maximum(size, 1e-150), 0.0)


def solve(A: Array, b: Array, ridge: Array | None = None, rank: float = RANK) -> Array:
    """Return the least-squares x (p,) of A @ x = b, of minimum norm where A lacks rank.

    ``ridge`` (<= p,) is one over the prior sigma of the first numbers about zero.
    """
    if not A.shape[1]:
        return np.zeros(0)
    ridges = np.zeros(A.shape[1])
    if ridge is not None:
        ridges[: len(ridge)] = ridge
    unit = inverse_lengths(A, ridges)
    if ridges.any():
        rows = np.flatnonzero(ridges)
        prior = np.zeros((len(rows), len(ridges)))
        prior[np.arange(len(rows)), rows] = ridges[rows]
        A, b = np.vstack([A, prior]), np.concatenate([b, np.zeros(len(rows))])
    return np.asarray(np.linalg.lstsq(A * unit, b, rcond=rank)[0] * unit)


def inverse(sums: Array, rank: float = SUMS_RANK) -> Array:
    """Return the inverse (p, p) of sums of products A^T A: the covariance under unit noise.

    Zero along directions without information.
    """
    unit = _inverted(np.sqrt(np.maximum(np.diag(sums), 0.0)))
    scaled = np.outer(unit, unit)
    return np.asarray(np.linalg.pinv(sums * scaled, rcond=rank, hermitian=True) * scaled)


def squared_sigmas(values: Array, covariance: Array) -> float:
    """Return the squared distance of values (p,) from zero, in sigmas of their covariance."""
    if len(values) == 1:  # the usual case, without a decomposition
        variance = float(covariance[0, 0])
        return float(values[0] ** 2 / variance) if variance else 0.0
    return float(values @ np.linalg.pinv(covariance, hermitian=True) @ values)


def bounded(A: Array, b: Array, lower: Array, upper: Array) -> tuple[Array, Mask]:
    """Return the least-squares x (p,) of A @ x = b within bounds, and which are on a bound (p,).

    Active sets with release: ends where the conditions of an optimum hold (Stark, Parker,
    "Bounded-Variable Least-Squares", Computational Statistics 10 (1995) 129).
    """
    unit, ends = inverse_lengths(A), (lower, upper)
    A, lower, upper = A * unit, *(_scaled(bound, unit) for bound in ends)
    x = np.linalg.lstsq(A, b, rcond=None)[0]
    on_bound = (x < lower) | (x > upper)
    x = np.clip(x, lower, upper)
    for _ in range(10 * len(x) + 10):
        free = ~on_bound
        target = x.copy()
        if free.any():
            target[free] = np.linalg.lstsq(
                A[:, free], b - A[:, on_bound] @ x[on_bound], rcond=None
            )[0]
        outside = free & ((target < lower) | (target > upper))
        if outside.any():  # up to the first bound on the way
            bound = np.where(target < lower, lower, upper)
            share = np.full(len(x), np.inf)
            share[outside] = (bound[outside] - x[outside]) / (target[outside] - x[outside])
            worst = int(np.argmin(share))
            x = np.clip(x + share[worst] * (target - x), lower, upper)
            x[worst], on_bound[worst] = bound[worst], True
            continue
        x = target
        gain = A.T @ (b - A @ x)
        gradient = np.where(x <= lower, gain, -gain) * on_bound
        worst = int(np.argmax(gradient))
        if gradient[worst] <= OPTIMAL * np.linalg.norm(b):
            break
        on_bound[worst] = False
    return np.clip(x * unit, *ends), on_bound


def _scaled(bound: Array, unit: Array) -> Array:
    """Return bounds (p,) scaled to unit columns; unscaled for an empty column."""
    return np.asarray(np.where(unit > 0, bound / np.where(unit > 0, unit, 1.0), bound))


def basis_of(columns: Array, rank: float = DEPENDENT) -> Array:
    """Return an orthonormal basis of columns (m, r), nearly dependent ones left out."""
    if not columns.shape[1]:
        return columns
    U, s, _ = np.linalg.svd(columns * inverse_lengths(columns), full_matrices=False)
    return np.asarray(U[:, s > rank * max(float(s[0]), 1e-300)])


def projected_out(basis: Array, columns: Array) -> Array:
    """Return columns (m, ...) minus their projection on an orthonormal basis (m, r)."""
    return np.asarray(columns - basis @ (basis.T @ columns))
