"""Type, arms and sessions as one normal model: means for given scatters, and scatters by EM.

A session's flexibilities scatter about its arm's (variance omega), an arm's about its type's (tau).
Of a session only its normal equations are needed. Units: the usual flexibility.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Mask

ROUNDS = 400
CONVERGED = 1e-5  # relative change of every scatter at which it has converged
SPREAD_WEIGHT = 3.0  # arms: weight of the scatter shared by all joints as a prior of a joint's
PRIOR_PRECISION = 0.1  # inverse prior sigma of a type's values about nominal
MAX_RELATIVE_STD = 0.3  # of the prior sigma; beyond it a value is not identifiable
INITIAL_SCATTER = 0.3  # relative, between arms
MIN_SCATTER, MAX_SCATTER = 0.01, 2.0  # bounds of relative scatters


@dataclass(frozen=True)
class Information:
    """Sessions in units of the usual flexibility and of their own noise."""

    M: Array  # (S, p, p) information of a session
    k: Array  # (S, p)
    arm: NDArray[np.int64]  # (S,)
    arms: int
    order: Array  # (S,) number of the session within its arm, from its arm's mean

    def of(self, arms: NDArray[np.int64]) -> Information:
        """Return some of the arms, renumbered."""
        number = np.full(self.arms, -1)
        number[arms] = np.arange(len(arms))
        kept = number[self.arm] >= 0
        return Information(
            self.M[kept], self.k[kept], number[self.arm[kept]], len(arms), self.order[kept]
        )

    def summed(self, values: Array) -> Array:
        """Return the sums over the sessions of each arm."""
        total = np.zeros((self.arms, *values.shape[1:]))
        np.add.at(total, self.arm, values)
        return total


@dataclass(frozen=True)
class Type:
    """Mean and scatters of a type, in units of the usual flexibility."""

    mean: Array  # (p,)
    covariance: Array  # (p, p)
    tau: Array  # (p,) variance between arms
    omega: Array  # (p,) variance between sessions of an arm


def marginalised(M: Array, variance: Array, *values: Array) -> list[Array]:
    """Return (I + M diag(variance))^-1 times M and further vectors.

    This converts information about x to information about x - d, with d of this variance.
    """
    p = M.shape[-1]
    root = np.eye(p) + M * variance
    columns = np.concatenate([M, *(v[..., None] for v in values)], axis=-1)
    shared = np.linalg.solve(root, columns)
    return [shared[..., :p], *(shared[..., p + i] for i in range(len(values)))]


def with_mean(data: Information, tau: Array, omega: Array, centre: Array) -> Type:
    """Return the type with its mean, for given scatters."""
    J, k = marginalised(data.M, omega, data.k)
    P, r = marginalised(data.summed(J), tau, data.summed(k))
    precision = PRIOR_PRECISION**2 * np.eye(len(centre))
    covariance = np.linalg.inv(P.sum(axis=0) + precision)
    mean = covariance @ (r.sum(axis=0) + PRIOR_PRECISION**2 * centre)
    return Type(mean, (covariance + covariance.T) / 2, tau, omega)


def estimate_type(data: Information, centre: Array) -> Type:
    """Return the type with its scatters, by EM."""
    p = len(centre)
    type_ = with_mean(data, np.ones(p), np.zeros(p), centre)
    repeated = len(data.arm) > data.arms
    size = scatter_scale(type_)
    tau = (INITIAL_SCATTER * size) ** 2
    omega = (0.2 * INITIAL_SCATTER * size) ** 2 if repeated else np.zeros(p)
    for _ in range(ROUNDS):
        type_ = with_mean(data, tau, omega, centre)
        size, known = scatter_scale(type_), identifiable(type_.covariance)
        between, within = _expected(data, type_)
        new_tau = _shrunk(between / data.arms / size**2, tau / size**2, known, data.arms) * size**2
        # one scatter for all flexibilities: few arms have enough sessions for more
        new_omega = _shared(within / len(data.arm) / size**2, known) * size**2 * repeated
        change = np.abs(np.log(new_tau / tau)).max()
        if repeated:
            change = max(change, float(np.abs(np.log(new_omega / omega)).max()))
        tau, omega = new_tau, new_omega
        if change < CONVERGED:
            break
    return with_mean(data, tau, omega, centre)


def scatter_scale(type_: Type) -> Array:
    """Return the flexibilities that scatters are relative to."""
    return np.maximum(np.abs(type_.mean), 0.1)


def identifiable(covariance: Array) -> Mask:
    """Return which of a type's flexibilities are identifiable, by their covariance."""
    return np.asarray(np.sqrt(np.diag(covariance)) < MAX_RELATIVE_STD / PRIOR_PRECISION)


def _shared(relative: Array, known: Mask) -> float:
    """Return the relative variance that all flexibilities share."""
    shared = float(np.mean(relative[known])) if known.any() else INITIAL_SCATTER**2
    return min(max(shared, MIN_SCATTER**2), MAX_SCATTER**2)


def _shrunk(relative: Array, before: Array, known: Mask, arms: int) -> Array:
    """Return relative variances (p,), shrunk towards the shared one."""
    shared = _shared(before, known)
    variance = (SPREAD_WEIGHT * shared + arms * relative) / (SPREAD_WEIGHT + arms)
    return np.where(known, np.clip(variance, MIN_SCATTER**2, MAX_SCATTER**2), shared)


def _expected(data: Information, type_: Type) -> tuple[Array, Array]:
    """Return the expected sums of squares (p,) between arms, and between sessions of an arm."""
    mean, covariance, shrinkage = arm_posterior(data, type_)
    J, k = marginalised(data.M, type_.omega, data.k)
    J, k = data.summed(J), data.summed(k)
    V = type_.tau[:, None] * shrinkage  # covariance of arm minus type, the type given
    delta = np.einsum("aij,aj->ai", V, k - J @ type_.mean)
    spread = V + V @ J @ type_.covariance @ J @ np.swapaxes(V, 1, 2)
    between = (delta**2 + np.einsum("aii->ai", spread)).sum(axis=0)
    W = type_.omega[:, None] * np.linalg.inv(np.eye(len(type_.mean)) + data.M * type_.omega)
    W = (W + W.swapaxes(1, 2)) / 2
    d = np.einsum("sij,sj->si", W, data.k - np.einsum("sij,sj->si", data.M, mean[data.arm]))
    remaining = W + W @ data.M @ covariance[data.arm] @ data.M @ W
    return between, (d**2 + np.einsum("sii->si", remaining)).sum(axis=0)


def arm_posterior(data: Information, type_: Type) -> tuple[Array, Array, Array]:
    """Return the arms' means (A, p), covariances (A, p, p), and shares of the type (A, p, p)."""
    J, k = marginalised(data.M, type_.omega, data.k)
    J, k = data.summed(J), data.summed(k)
    shrinkage = np.linalg.inv(np.eye(len(type_.mean)) + J * type_.tau).swapaxes(
        1, 2
    )  # (I + T J)^-1
    V = type_.tau[:, None] * shrinkage.swapaxes(1, 2)
    V = (V + V.swapaxes(1, 2)) / 2
    mean = np.einsum("aij,aj->ai", V, k) + shrinkage @ type_.mean
    covariance = V + shrinkage @ type_.covariance @ shrinkage.swapaxes(1, 2)
    return np.asarray(mean), np.asarray(covariance), np.array(shrinkage.swapaxes(1, 2), dtype=float)
