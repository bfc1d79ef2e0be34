"""One linear step of a calibration: parameters and nuisances fitted to the residuals.

Equations are divided by the noise; parameters have a weak prior, nuisances none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array, Index, Mask
from gapbridge.core.estimation.least_squares import bounded, inverse


@dataclass(frozen=True)
class Bounds:
    """Bounds of the parameters (p,), and their prior."""

    lower: Array
    upper: Array
    prior_std: Array  # (p,) 1 sigma about ``begin``
    begin: Array  # (p,)


@dataclass(frozen=True)
class System:
    """residual = J step + F nuisance step + noise, all divided by the noise."""

    J: Array  # (M, p)
    F: Array  # (M, m)
    residual: Array  # (M,)

    def weighted(self, root: Array) -> System:
        """Return the system with each equation times ``root`` (M,)."""
        return System(self.J * root[:, None], self.F * root[:, None], self.residual * root)


def solve(
    system: System, values: Array, bounds: Bounds, free: Mask, damping: float = 0.0
) -> tuple[Array, Array, Mask]:
    """Return the steps of parameters (p,) and nuisances (m,), and which are on a bound (p,).

    Parameters not ``free`` have a zero step. ``damping`` is Marquardt's, relative to the columns.
    """
    J, prior_std = system.J[:, free], bounds.prior_std[free]
    p, m = J.shape[1], system.F.shape[1]
    rows = [np.hstack([J, system.F]), np.hstack([np.diag(1 / prior_std), np.zeros((p, m))])]
    right = [system.residual, (bounds.begin - values)[free] / prior_std]
    if damping > 0:
        length = np.hypot(np.linalg.norm(J, axis=0), 1 / prior_std)
        rows.append(np.hstack([np.diag(np.sqrt(damping) * length), np.zeros((p, m))]))
        right.append(np.zeros(p))
    wide = np.full(m, np.inf)
    found, on_bound = bounded(
        np.vstack(rows), np.concatenate(right),
        np.concatenate([(bounds.lower - values)[free], -wide]),
        np.concatenate([(bounds.upper - values)[free], wide]),
    )  # fmt: skip
    step, on_bound_all = np.zeros(len(values)), np.zeros(len(values), dtype=bool)
    step[free], on_bound_all[free] = found[:p], on_bound[:p]
    return step, found[p:], on_bound_all


def posterior(system: System, bounds: Bounds) -> tuple[Array, float, Array]:
    """Return the covariance (p, p), the effective number of parameters, and the leverages (M,).

    Without the bounds; the nuisances are projected out of the covariance.
    """
    p = system.J.shape[1]
    A, whole = columns_and_covariance(system, bounds)
    share = np.einsum("ij,jk,ik->i", A, whole, A)
    covariance = whole[:p, :p]
    return np.asarray((covariance + covariance.T) / 2), float(share.sum()), share


def joint_covariance(system: System, bounds: Bounds, repeat: Index) -> Array:
    """Return the covariance of parameters and nuisances together (p + m, p + m).

    ``repeat`` (N,) groups the readings whose errors may be correlated: repeats of a pose share
    encoder rounding and joint errors.
    """
    A, covariance = columns_and_covariance(system, bounds)
    return covariance + _shared_error_covariance(A, system.residual, covariance, repeat)


def _shared_error_covariance(A: Array, residual: Array, core: Array, repeat: Index) -> Array:
    """Return the contribution of correlated errors of repeats to the covariance ``core`` of a fit.

    Errors have variance 1; the correlation between repeats is estimated from the products of their
    residuals, corrected for the fit (analysis of variance).
    """
    number, count = np.unique(repeat, return_inverse=True, return_counts=True)[1:]
    k = len(residual) // len(number)
    sums, residual_sums = np.zeros((len(count), k, A.shape[1])), np.zeros((len(count), k))
    np.add.at(sums, number, A.reshape(len(number), k, -1))
    np.add.at(residual_sums, number, residual.reshape(-1, k))
    square = A.T @ A
    pairs = np.einsum("gki,gkj->ij", sums, sums) - square
    twice = np.einsum("g,gki,gkj->ij", count - 2.0, sums, sums) + square
    influence = core @ pairs
    # expected products of repeats' residuals for white noise, and their rate with the correlation
    white = -float(np.trace(influence))
    slope = k * float(np.sum(count * (count - 1.0)))
    slope += float(np.sum(influence * influence.T)) - 2 * float(np.sum(core * twice))
    if slope <= 1.0:
        return np.zeros_like(core)
    excess = float(np.sum(residual_sums**2) - np.sum(residual**2))
    shared = min(max((excess - white) / slope, 0.0), 1.0)
    return np.asarray(shared * (influence @ core))


def columns_and_covariance(system: System, bounds: Bounds) -> tuple[Array, Array]:
    """Return the columns of parameters and nuisances (M, p + m), and their covariance.

    Zero along directions without information from equations or priors.
    """
    A = np.hstack([system.J, system.F])
    precision = np.concatenate([1 / bounds.prior_std**2, np.zeros(system.F.shape[1])])
    return A, inverse(A.T @ A + np.diag(precision))
