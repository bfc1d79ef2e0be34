"""The compliance of a fleet: flexibilities of a type, of its arms, of their sessions.

An arm's flexibilities scatter about its type's, a session's about its arm's; both scatters, the
noise and the type's values are estimated from the whole fleet (empirical Bayes: Efron, Morris, J.
Am. Stat. Assoc. 70 (1975) 311; by EM: Dempster, Laird, Rubin, J. R. Stat. Soc. B 39 (1977) 1), so
that an arm with few poses is drawn to its type where its own data say little. Everything is normal
and linear: of a session only its normal matrix is needed.

How well a fleet determines its scatters: draws from their posterior given the data.

With few arms the scatter between them is itself uncertain, and intervals that take it as known are
too narrow (Kass, Steffey, J. Am. Stat. Assoc. 84 (1989) 717). Gibbs sampling (Gelfand, Smith,
J. Am. Stat. Assoc. 85 (1990) 398): every conditional is normal or an inverse gamma.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.stats import chi2

from gapbridge.core.arrays import Array
from gapbridge.core.estimation.hierarchical_evidence import Evidence
from gapbridge.core.estimation.hierarchical_prior import (
    BEGIN,
    LARGEST,
    SMALLEST,
    SPREAD_WEIGHT,
    Information,
    Type,
    arm_posterior,
    estimated,
    shown,
    size_of,
    through,
    with_mean,
)

WARM_UP, APART, KEPT = 60, 8, 40
SESSION_WEIGHT = 1.0  # what the first guess of the sessions' scatter counts for
MOST = 400  # arms from which scatters are estimated: more add hardly anything
SURE = 100  # arms from which on the scatters count as known
NOISE_WEIGHT = 10.0  # coordinates that the type's noise counts for beside a session's own


@dataclass(frozen=True)
class Scatter:
    """The type: its flexibilities, and how arms and sessions scatter about them."""

    mean: Array  # (2n,) rad/Nm
    covariance: Array  # (2n, 2n) of the mean
    between_arms: Array  # (2n,) rad/Nm, 1 sigma
    between_sessions: Array  # (2n,) rad/Nm, 1 sigma
    noise: float  # m, 1 sigma of one coordinate, of a usual session
    arms: int
    sessions: int
    shown: NDArray[np.bool_]  # (2n,) by any session; the others stand about the nominal's value


@dataclass(frozen=True)
class ArmFit:
    """One arm: its flexibilities, given all."""

    flexibility: Array  # (2n,) rad/Nm, not below zero
    covariance: Array  # (2n, 2n)
    own: Array  # (2n,) share of the value that comes from the arm's own data: 0 the type's, 1 its
    beside_type: Array  # (2n,) difference from the type, in sigma of what arms scatter
    drift: Array  # (2n,) rad/Nm from one session to the next; nan: fewer than three
    drift_std: Array  # (2n,)

    @property
    def std(self) -> Array:
        """Return 1 sigma (2n,) of the flexibilities, rad/Nm."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class SessionFit:
    """One session, given all others."""

    flexibility: Array  # (2n,) rad/Nm
    std: Array  # (2n,)
    noise: float  # m, 1 sigma of one coordinate
    without: Array  # (2n,) rad/Nm, of its arm if this session had not been
    surprise: float  # how badly it fits its arm: chi-squared over its freedom


@dataclass(frozen=True)
class TypeFit:
    """All arms of one type."""

    scatter: Scatter
    arms: tuple[ArmFit, ...]
    sessions: tuple[SessionFit, ...]


def fit_type(
    sessions: Sequence[Evidence], arm: Sequence[int], nominal: Array, usual: float
) -> TypeFit:
    """Return the fit of all arms of a type.

    ``arm`` numbers each session's arm from 0, sessions of an arm in their order in time;
    ``nominal`` (2n,) rad/Nm holds, weakly, what no session shows; ``usual`` (rad/Nm) is the size of
    a usual flexibility.
    """
    noise = _noise(sessions)
    data = _data(sessions, np.asarray(arm, dtype=np.int64), noise, usual)
    centre = nominal / usual
    chosen = data
    if data.arms > MOST:
        chosen = data.of(np.random.default_rng(0).permutation(data.arms)[:MOST])
    found = estimated(chosen, centre)
    believed = [found]
    if chosen is not data:
        believed = [found := with_mean(data, found.tau, found.omega, centre)]
    elif data.arms < SURE:
        believed = draws(data, found, centre)
        found = _averaged(believed)
    typical = float(np.sqrt(np.median(noise)))
    scatter = Scatter(
        found.mean * usual, found.covariance * usual**2, np.sqrt(found.tau) * usual,
        np.sqrt(found.omega) * usual, typical, data.arms, len(sessions), shown(found.covariance),
    )  # fmt: skip
    return TypeFit(
        scatter, tuple(_arms(data, found, believed, usual)),
        tuple(_sessions(data, found, sessions, noise, usual)),
    )  # fmt: skip


def _noise(sessions: Sequence[Evidence]) -> Array:
    """Return the variance (S,) of one coordinate of each session, its own held by the type's."""
    squares = np.array([s.squares for s in sessions])
    freedom = np.array([s.freedom for s in sessions])
    least = np.array([s.least for s in sessions]) ** 2
    known = freedom >= 1
    typical = float(np.median(least))
    if known.any():
        # the weighted median: a few sessions gone wrong do not spoil it for all
        each = squares[known] / chi2.median(freedom[known])
        order = np.argsort(each)
        weight = np.cumsum(freedom[known][order])
        middle = order[np.searchsorted(weight, weight[-1] / 2)]
        typical = max(float(each[middle]), typical)
    shared = (NOISE_WEIGHT * typical + squares) / (NOISE_WEIGHT + freedom)
    return np.asarray(np.maximum(shared, least))


def _data(
    sessions: Sequence[Evidence], arm: NDArray[np.int64], noise: Array, usual: float
) -> Information:
    R = np.stack([s.matrix for s in sessions]) * usual
    right = np.stack([s.right for s in sessions])
    M = np.swapaxes(R, 1, 2) @ R / noise[:, None, None]
    k = np.einsum("sij,si->sj", R, right) / noise[:, None]
    return Information(M, k, arm, int(arm.max()) + 1, _order(arm))


def _order(arm: NDArray[np.int64]) -> Array:
    """Return the number (S,) of each session within its arm, counted from the arm's middle."""
    count = np.bincount(arm)
    sorted_ = np.argsort(arm, kind="stable")
    order = np.empty(len(arm))
    order[sorted_] = np.arange(len(arm)) - np.repeat(np.cumsum(count) - count, count)
    return order - (count[arm] - 1) / 2


def _averaged(believed: Sequence[Type]) -> Type:
    """Return one type for many that are believed alike."""
    means = np.stack([b.mean for b in believed])
    covariance = np.mean([b.covariance for b in believed], axis=0) + np.cov(means.T)
    tau, omega = (np.mean([getattr(b, n) for b in believed], axis=0) for n in ("tau", "omega"))
    return Type(means.mean(axis=0), covariance, tau, omega)


def _arms(data: Information, now: Type, believed: Sequence[Type], usual: float) -> list[ArmFit]:
    mean, covariance, own = _arm_beliefs(data, believed)
    share = 1 - np.clip(np.einsum("aii->ai", own), 0, 1)
    drift, drift_std = _drifts(data, now)
    beside = (mean - now.mean) / np.sqrt(now.tau)
    return [
        ArmFit(
            np.maximum(mean[a], 0) * usual, covariance[a] * usual**2, share[a], beside[a],
            drift[a] * usual, drift_std[a] * usual,
        )
        for a in range(data.arms)
    ]  # fmt: skip


def _arm_beliefs(data: Information, believed: Sequence[Type]) -> tuple[Array, Array, Array]:
    """Return means, covariances and shares of the type, averaged over what is believed of it."""
    each = [arm_posterior(data, b) for b in believed]
    means = np.stack([e[0] for e in each])
    off = means - means.mean(axis=0)
    between = np.einsum("bai,baj->aij", off, off) / len(each)
    covariance = np.mean([e[1] for e in each], axis=0) + between
    return means.mean(axis=0), covariance, np.mean([e[2] for e in each], axis=0)


def _drifts(data: Information, now: Type) -> tuple[Array, Array]:
    """Return slope and 1 sigma (A, p) of each flexibility over the sessions, one at a time."""
    J, k = through(data.M, now.omega, data.k)
    t = data.order
    J0, J1, J2 = (data.summed(J * (t**i)[:, None, None]) for i in range(3))
    k0, k1 = (data.summed(k * (t**i)[:, None]) for i in range(2))
    V = np.linalg.inv(J0 + np.diag(1 / now.tau))
    level = np.einsum("aij,aj->ai", V, k0 + now.mean / now.tau)
    information = np.einsum("ajj->aj", J2) - np.einsum("aij,aik,akj->aj", J1, V, J1)
    score = k1 - np.einsum("aij,ai->aj", J1, level)
    enough = np.bincount(data.arm, minlength=data.arms)[:, None] >= 3
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(enough & (information > 1e-12), score / information, np.nan)
        std = np.where(np.isfinite(slope), 1 / np.sqrt(information), np.nan)
    return slope, std


def _sessions(
    data: Information, now: Type, given: Sequence[Evidence], noise: Array, usual: float
) -> list[SessionFit]:
    mean, covariance, _ = arm_posterior(data, now)
    without = _without(data, now)
    found = []
    for s, one in enumerate(given):
        M, arm = data.M[s], int(data.arm[s])
        W = np.linalg.inv(np.eye(len(M)) + now.omega[:, None] * M) * now.omega
        d = W @ (data.k[s] - M @ mean[arm])
        own, rest = mean[arm] + d, np.eye(len(M)) - W @ M
        left = one.matrix @ (own * usual) - one.right
        squares = float(left @ left) + one.squares
        typical = float(np.median(noise))
        rows = one.freedom + np.linalg.matrix_rank(one.matrix)
        found.append(SessionFit(
            own * usual, np.sqrt(np.diag(W + rest @ covariance[arm] @ rest.T)) * usual,
            float(np.sqrt(noise[s])), np.maximum(without[s], 0) * usual,
            squares / max(rows * typical, 1e-300),
        ))  # fmt: skip
    return found


def _without(data: Information, now: Type) -> Array:
    """Return each session's arm (S, p) as all its other sessions report it."""
    J, k = through(data.M, now.omega, data.k)
    J, k = data.summed(J)[data.arm] - J, data.summed(k)[data.arm] - k
    own = np.linalg.inv(np.eye(len(now.mean)) + now.tau[:, None] * J)
    return np.asarray(np.einsum("sij,sj->si", own, now.mean + now.tau * k))


def draws(data: Information, begin: Type, centre: Array) -> list[Type]:
    """Return types with scatters drawn from their posterior, each with its own mean."""
    rng = np.random.default_rng(0)
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
