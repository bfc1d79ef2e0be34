"""What readings determine: the information matrix of parameters and nuisances.

Everything is counted in usual sizes: a parameter in its weak prior's sigma, a nuisance in metres
and radians. The nuisances stay in the matrix, so that its inverse has them projected out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.nuisance import Layout, Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Expectation
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.loads import Loads

UNSHOWN = 0.95  # of the prior's sigma: what readings leave no better known they do not show


@dataclass(frozen=True)
class Reference:
    """Where the TCP's prediction matters: M poses under loads that the arm will work with."""

    q: Array  # (M, n) rad
    loads: Loads
    columns: Array  # (M, 3, p) m a prior's sigma: what each parameter does to the TCP there

    @classmethod
    def of(cls, parameters: Parameters, q: Array, loads: Loads) -> Reference:
        """Return the reference at poses ``q`` (M, n)."""
        columns = parameters.tcp_jacobian(parameters.begin, q, loads)
        return cls(q, loads, columns * parameters.prior)

    def weight(self, size: int, share: Array | None = None) -> Array:
        """Return W (size, size): trace(W covariance) is the mean square TCP error, m^2.

        ``share`` (M,), of mean 1, weighs the poses.
        """
        p = self.columns.shape[2]
        root = 1.0 if share is None else np.sqrt(share)[:, None, None]
        flat = (self.columns * root).reshape(-1, p)
        W = np.zeros((size, size))
        W[:p, :p] = flat.T @ flat / len(self.q)
        return W

    def std(self, covariance: Array) -> Array:
        """Return 1 sigma (3D) of the predicted TCP at each pose (M,), m."""
        p = self.columns.shape[2]
        spread = np.einsum("mkp,pq,mkq->m", self.columns, covariance[:p, :p], self.columns)
        return np.asarray(np.sqrt(np.maximum(spread, 0.0)))


def blocks(
    parameters: Parameters,
    observable: Observable,
    readings: Readings,
    nuisance: Nuisance,
    sigma: float,
    layout: Layout | None = None,
) -> Array:
    """Return the equations of each reading (N, k, p+m), in units of noise and usual sizes."""
    J, F = observable.columns(parameters, parameters.begin, readings, nuisance, layout)
    whole = np.hstack([J * parameters.prior, F])
    whole = whole.reshape(len(readings), observable.equations, whole.shape[1])
    return np.asarray(whole / (sigma * observable.sigmas)[None, :, None])


def information_of(rows: Array) -> Array:
    """Return the information (P, P) of equations (N, k, P), weak prior included."""
    flat = rows.reshape(-1, rows.shape[2])
    return np.asarray(np.eye(rows.shape[2]) + flat.T @ flat)


def inverse(information: Array) -> Array:
    """Return the covariance (P, P)."""
    root = np.linalg.inv(np.linalg.cholesky(information))
    return np.asarray(root.T @ root)


def expectation_of(parameters: Parameters, rows: Array, reference: Reference) -> Expectation:
    """Return what equations (N, k, p+m) will determine."""
    covariance = inverse(information_of(rows))
    share = np.sqrt(np.diag(covariance))[: len(parameters)]
    std = np.where(share < UNSHOWN, share * parameters.prior, np.inf)
    tcp = reference.std(covariance)
    return Expectation(
        parameters.names, parameters.units, std, parameters.scales.copy(),
        float(np.sqrt(np.mean(tcp**2))), float(tcp.max()),
    )  # fmt: skip
