"""Information matrix of readings, for parameters and nuisances.

A parameter is scaled by the sigma of its weak prior; nuisances are in metres and radians. The
nuisances are part of the matrix: its inverse marginalises over them.
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

UNIDENTIFIED = 0.95  # of the prior's sigma: a larger std counts as not identifiable


@dataclass(frozen=True)
class Reference:
    """M poses at which the accuracy of the predicted TCP is evaluated."""

    q: Array  # (M, n) rad
    columns: Array  # (M, 3, p) d TCP / d parameter, m per prior sigma

    @classmethod
    def of(cls, parameters: Parameters, q: Array, loads: Loads) -> Reference:
        """Return the reference at poses ``q`` (M, n) under their loads."""
        columns = parameters.tcp_jacobian(parameters.begin, q, loads)
        return cls(q, columns * parameters.prior)

    def weight(self, size: int, share: Array | None = None) -> Array:
        """Return W (size, size): trace(W covariance) is the mean square TCP error, m^2.

        ``share`` (M,), of mean 1, are the weights of the poses.
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


def whitened_rows(
    parameters: Parameters,
    observable: Observable,
    readings: Readings,
    nuisance: Nuisance,
    sigma: float,
    layout: Layout | None = None,
) -> Array:
    """Return the equations of each reading (N, k, p+m), divided by noise, times prior sigmas."""
    J, F = observable.columns(parameters, parameters.begin, readings, nuisance, layout)
    columns = np.hstack([J * parameters.prior, F])
    columns = columns.reshape(len(readings), observable.equations, columns.shape[1])
    return np.asarray(columns / (sigma * observable.sigmas)[None, :, None])


def information_of(rows: Array) -> Array:
    """Return the information (P, P) of equations (N, k, P), weak prior included."""
    flat = rows.reshape(-1, rows.shape[2])
    return np.asarray(np.eye(rows.shape[2]) + flat.T @ flat)


def inverse(information: Array) -> Array:
    """Return the covariance (P, P)."""
    root = np.linalg.inv(np.linalg.cholesky(information))
    return np.asarray(root.T @ root)


def expected_accuracy(parameters: Parameters, rows: Array, reference: Reference) -> Expectation:
    """Return the expected standard deviations for equations (N, k, p+m)."""
    covariance = inverse(information_of(rows))
    share = np.sqrt(np.diag(covariance))[: len(parameters)]
    std = np.where(share < UNIDENTIFIED, share * parameters.prior, np.inf)
    tcp = reference.std(covariance)
    return Expectation(
        parameters.names, parameters.units, std, parameters.scales.copy(),
        float(np.sqrt(np.mean(tcp**2))), float(tcp.max()),
    )  # fmt: skip
