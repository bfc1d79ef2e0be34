"""How well a fleet determines its scatters: draws from their posterior given the data.

With few arms the scatter between them is itself uncertain, and intervals that take it as known are
too narrow (Kass, Steffey, J. Am. Stat. Assoc. 84 (1989) 717). Gibbs sampling (Gelfand, Smith,
J. Am. Stat. Assoc. 85 (1990) 398): every conditional is normal or an inverse gamma.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from gapbridge.core.arrays import Array
from gapbridge.core.estimation.hierarchical_prior import (
    BEGIN,
    LARGEST,
    SMALLEST,
    SPREAD_WEIGHT,
    Information,
    Type,
    shown,
    size_of,
    through,
    with_mean,
)

WARM_UP, APART, KEPT = 60, 8, 40
SESSION_WEIGHT = 1.0  # what the first guess of the sessions' scatter counts for


def draws(data: Information, begin: Type, centre: Array, seed: int = 0) -> list[Type]:
    """Return types with scatters drawn from their posterior, each with its own mean."""
    rng = np.random.default_rng(seed)
    repeated = len(data.arm) > data.arms
    size, seen = size_of(begin), shown(begin.covariance)
    now = begin
    shared = float(np.mean((begin.tau / size**2)[seen])) if seen.any() else BEGIN**2
    kept = []
    for turn in range(WARM_UP + KEPT * APART):
        delta, d = _effects(data, now, rng)
        relative = np.sum((delta / size) ** 2, axis=0)
        tau = (SPREAD_WEIGHT * shared + relative) / rng.chisquare(
            SPREAD_WEIGHT + data.arms, len(size)
        )  # fmt: skip
        tau = np.clip(tau, SMALLEST**2, LARGEST**2)
        shared = _shared(tau[seen], rng) if seen.any() else shared
        tau = np.where(seen, tau, shared)
        omega = now.omega
        if repeated:
            total = SESSION_WEIGHT * (0.2 * BEGIN) ** 2 + np.sum((d / size)[:, seen] ** 2)
            freedom = SESSION_WEIGHT + len(data.arm) * int(seen.sum())
            scale = np.clip(total / rng.chisquare(freedom), SMALLEST**2, LARGEST**2)
            omega = scale * size**2
        now = with_mean(data, tau * size**2, omega, centre)
        if turn >= WARM_UP and (turn - WARM_UP) % APART == 0:
            kept.append(now)
    return kept


def _shared(tau: Array, rng: Generator) -> float:
    """Draw the relative variance that all flexibilities share: a gamma, its inverses summed."""
    shape = 0.5 * SPREAD_WEIGHT * len(tau)
    rate = 0.5 * SPREAD_WEIGHT * float(np.sum(1 / tau))
    return float(np.clip(rng.gamma(shape) / rate, SMALLEST**2, LARGEST**2))


def _effects(data: Information, now: Type, rng: Generator) -> tuple[Array, Array]:
    """Draw what arms differ from their type (A, p) and sessions from their arm (S, p)."""
    p = len(now.mean)
    mean = now.mean + np.linalg.cholesky(now.covariance) @ rng.normal(size=p)
    J, k = through(data.M, now.omega, data.k)
    J, k = data.summed(J), data.summed(k)
    delta = _drawn(J, k - J @ mean, now.tau, rng)
    left = data.k - np.einsum("sij,sj->si", data.M, (mean + delta)[data.arm])
    return delta, _drawn(data.M, left, now.omega, rng)


def _drawn(M: Array, k: Array, variance: Array, rng: Generator) -> Array:
    """Draw x (N, p) from its posterior: prior N(0, variance), information M, right side k."""
    root = np.sqrt(variance)
    precision = np.eye(len(variance)) + root[:, None] * M * root
    L = np.linalg.cholesky(precision)
    right = (root * k)[..., None]
    noise = rng.normal(size=right.shape)
    # precision x = right + L noise has the mean and the covariance that are wanted
    return np.asarray(root * np.linalg.solve(precision, right + L @ noise)[..., 0])
