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
SPREAD_WEIGHT = 3.0  # arms that the scatter of all joints counts for beside a joint's own
WEAK = 0.1  # of a type's values, per usual flexibility: what no session shows stays at the nominal
VAGUE = 0.3  # share of that sigma: a value that is known no better counts as not identifiable
BEGIN = 0.3  # relative scatter of arms to begin with
SMALLEST, LARGEST = 0.01, 2.0  # relative scatters that are believed


@dataclass(frozen=True)
class Information:
    """Sessions in units of the usual flexibility and of their own noise."""

    M: Array  # (S, p, p) information of a session
    k: Array  # (S, p)
    arm: NDArray[np.int64]  # (S,)
    arms: int
    order: Array  # (S,) number of the session within its arm, from its arm's mean

    def of(self, arms: NDArray[np.int64]) -> Information:
        """Return some of the arms, numbered anew."""
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
    """What is estimated of a type, in units of the usual flexibility."""

    mean: Array  # (p,)
    covariance: Array  # (p, p)
    tau: Array  # (p,) variance between arms
    omega: Array  # (p,) variance between sessions of an arm


def through(M: Array, variance: Array, *values: Array) -> list[Array]:
    """Return (I + M diag(variance))^-1 times M and further vectors: what is left of information.

    Passing on what is known of x to x - d, where d has this variance.
    """
    p = M.shape[-1]
    root = np.eye(p) + M * variance
    columns = np.concatenate([M, *(v[..., None] for v in values)], axis=-1)
    found = np.linalg.solve(root, columns)
    return [found[..., :p], *(found[..., p + i] for i in range(len(values)))]


def with_mean(data: Information, tau: Array, omega: Array, centre: Array) -> Type:
    """Return the type with its mean, for given scatters."""
    J, k = through(data.M, omega, data.k)
    P, r = through(data.summed(J), tau, data.summed(k))
    held = WEAK**2 * np.eye(len(centre))
    covariance = np.linalg.inv(P.sum(axis=0) + held)
    mean = covariance @ (r.sum(axis=0) + WEAK**2 * centre)
    return Type(mean, (covariance + covariance.T) / 2, tau, omega)


def estimated(data: Information, centre: Array) -> Type:
    """Return the type with its scatters, by EM."""
    p = len(centre)
    now = with_mean(data, np.ones(p), np.zeros(p), centre)
    repeated = len(data.arm) > data.arms
    size = size_of(now)
    tau = (BEGIN * size) ** 2
    omega = (0.2 * BEGIN * size) ** 2 if repeated else np.zeros(p)
    for _ in range(ROUNDS):
        now = with_mean(data, tau, omega, centre)
        size, seen = size_of(now), shown(now.covariance)
        between, within = _expected(data, now)
        new_tau = _held(between / data.arms / size**2, tau / size**2, seen, data.arms) * size**2
        # of sessions one number is estimated: few arms have enough of them for more
        new_omega = _shared(within / len(data.arm) / size**2, seen) * size**2 * repeated
        change = np.abs(np.log(new_tau / tau)).max()
        if repeated:
            change = max(change, float(np.abs(np.log(new_omega / omega)).max()))
        tau, omega = new_tau, new_omega
        if change < CONVERGED:
            break
    return with_mean(data, tau, omega, centre)


def size_of(now: Type) -> Array:
    """Return the flexibilities that scatters are shares of."""
    return np.maximum(np.abs(now.mean), 0.1)


def shown(covariance: Array) -> Mask:
    """Return which of a type's flexibilities any session shows, in units of the usual one."""
    return np.asarray(np.sqrt(np.diag(covariance)) < VAGUE / WEAK)


def _shared(relative: Array, seen: Mask) -> float:
    """Return the relative variance that all flexibilities share."""
    found = float(np.mean(relative[seen])) if seen.any() else BEGIN**2
    return min(max(found, SMALLEST**2), LARGEST**2)


def _held(relative: Array, before: Array, seen: Mask, arms: int) -> Array:
    """Return relative variances (p,), held by the one that all share."""
    shared = _shared(before, seen)
    found = (SPREAD_WEIGHT * shared + arms * relative) / (SPREAD_WEIGHT + arms)
    return np.where(seen, np.clip(found, SMALLEST**2, LARGEST**2), shared)


def _expected(data: Information, now: Type) -> tuple[Array, Array]:
    """Return the expected sums of squares (p,) between arms, and between sessions of an arm."""
    mean, covariance, own = arm_posterior(data, now)
    J, k = through(data.M, now.omega, data.k)
    J, k = data.summed(J), data.summed(k)
    V = now.tau[:, None] * own  # covariance of arm minus type, the type given
    delta = np.einsum("aij,aj->ai", V, k - J @ now.mean)
    spread = V + V @ J @ now.covariance @ J @ np.swapaxes(V, 1, 2)
    between = (delta**2 + np.einsum("aii->ai", spread)).sum(axis=0)
    W = now.omega[:, None] * np.linalg.inv(np.eye(len(now.mean)) + data.M * now.omega)
    W = (W + W.swapaxes(1, 2)) / 2
    d = np.einsum("sij,sj->si", W, data.k - np.einsum("sij,sj->si", data.M, mean[data.arm]))
    left = W + W @ data.M @ covariance[data.arm] @ data.M @ W
    return between, (d**2 + np.einsum("sii->si", left)).sum(axis=0)


def arm_posterior(data: Information, now: Type) -> tuple[Array, Array, Array]:
    """Return the arms' means (A, p), covariances (A, p, p), and shares of the type (A, p, p)."""
    J, k = through(data.M, now.omega, data.k)
    J, k = data.summed(J), data.summed(k)
    own = np.linalg.inv(np.eye(len(now.mean)) + J * now.tau).swapaxes(1, 2)  # (I + T J)^-1
    V = now.tau[:, None] * own.swapaxes(1, 2)
    V = (V + V.swapaxes(1, 2)) / 2
    mean = np.einsum("aij,aj->ai", V, k) + own @ now.mean
    covariance = V + own @ now.covariance @ own.swapaxes(1, 2)
    return np.asarray(mean), np.asarray(covariance), np.array(own.swapaxes(1, 2), dtype=float)
