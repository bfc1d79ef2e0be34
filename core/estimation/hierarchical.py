"""Hierarchical model of a fleet's compliance: types, their arms, the arms' sessions.

An arm's flexibilities scatter about its type's, a session's about its arm's. Both scatters, the
noise and the type's values are estimated from the whole fleet (empirical Bayes: Efron, Morris, J.
Am. Stat. Assoc. 70 (1975) 311; by EM: Dempster, Laird, Rubin, J. R. Stat. Soc. B 39 (1977) 1); an
arm with few poses is shrunk towards its type. The model is normal and linear: of a session only the
normal equations are needed.

With few arms the scatter between them is uncertain, and intervals that ignore this are too narrow
(Kass, Steffey, J. Am. Stat. Assoc. 84 (1989) 717): the scatters are then sampled from their
posterior by Gibbs sampling (Gelfand, Smith, J. Am. Stat. Assoc. 85 (1990) 398); every conditional
is normal or an inverse gamma.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.stats import chi2

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.estimation.hierarchical_evidence import Evidence

BURN_IN, THINNING, SAMPLES = 60, 8, 40
SESSION_WEIGHT = 1.0  # degrees of freedom of the prior of the sessions' scatter
MAX_ARMS = 400  # arms used to estimate the scatters
MANY_ARMS = 100  # arms from which on the scatters count as known
NOISE_WEIGHT = 10.0  # degrees of freedom of the type's noise as a prior of a session's
ROUNDS = 400
CONVERGED = 1e-5  # relative change of every scatter at which it has converged
SPREAD_WEIGHT = 3.0  # arms: weight of the scatter shared by all joints as a prior of a joint's
PRIOR_PRECISION = 0.1  # inverse prior sigma of a type's values about nominal
MAX_RELATIVE_STD = 0.3  # of the prior sigma; beyond it a value is not identifiable
INITIAL_SCATTER = 0.3  # relative, between arms
MIN_SCATTER, MAX_SCATTER = 0.01, 2.0  # bounds of relative scatters


@dataclass(frozen=True)
class Scatter:
    """The type: its flexibilities, and how arms and sessions scatter about them."""

    mean: Array  # (2n,) rad/Nm, not below zero
    covariance: Array  # (2n, 2n) of the mean
    between_arms: Array  # (2n,) rad/Nm, 1 sigma
    between_sessions: Array  # (2n,) rad/Nm, 1 sigma
    noise: float  # m, 1 sigma of one coordinate, of a usual session
    arms: int
    sessions: int
    identifiable: NDArray[np.bool_]  # (2n,) by any session; the others are near nominal


@dataclass(frozen=True)
class ArmFit:
    """One arm: its flexibilities by all data of the fleet."""

    flexibility: Array  # (2n,) rad/Nm, not below zero
    covariance: Array  # (2n, 2n)
    own_share: Array  # (2n,) weight of the arm's data: 0 only the type's, 1 only its own
    beside_type: Array  # (2n,) difference from the type, in sigmas of the scatter between arms
    drift: Array  # (2n,) rad/Nm per session; nan: fewer than three sessions
    drift_std: Array  # (2n,)

    @property
    def std(self) -> Array:
        """Return 1 sigma (2n,) of the flexibilities, rad/Nm."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class SessionFit:
    """One session, by all data of the fleet."""

    flexibility: Array  # (2n,) rad/Nm
    std: Array  # (2n,)
    noise: float  # m, 1 sigma of one coordinate
    without: Array  # (2n,) rad/Nm, of its arm without this session
    surprise: float  # chi-squared of its residual by the arm's values, over its freedom


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
    if data.arms > MAX_ARMS:
        chosen = data.of(np.random.default_rng(0).permutation(data.arms)[:MAX_ARMS])
    type_fit = estimate_type(chosen, centre)
    samples = [type_fit]
    if chosen is not data:
        samples = [type_fit := with_mean(data, type_fit.tau, type_fit.omega, centre)]
    elif data.arms < MANY_ARMS:
        samples = draws(data, type_fit, centre)
        type_fit = _averaged(samples)
    typical = float(np.sqrt(np.median(noise)))
    scatter = Scatter(
        np.maximum(type_fit.mean, 0) * usual, type_fit.covariance * usual**2,
        np.sqrt(type_fit.tau) * usual, np.sqrt(type_fit.omega) * usual, typical, data.arms,
        len(sessions), identifiable(type_fit.covariance),
    )  # fmt: skip
    return TypeFit(
        scatter, tuple(_arms(data, type_fit, samples, usual)),
        tuple(_sessions(data, type_fit, sessions, noise, usual)),
    )  # fmt: skip


def _noise(sessions: Sequence[Evidence]) -> Array:
    """Return the variance (S,), m2, of one coordinate of each session, shrunk to the type's."""
    squares = np.array([s.squares for s in sessions])
    freedom = np.array([s.freedom for s in sessions])
    least = np.array([s.least for s in sessions]) ** 2
    known = freedom >= 1
    typical = float(np.median(least))
    if known.any():
        # the weighted median is robust against a few bad sessions
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


def _averaged(samples: Sequence[Type]) -> Type:
    """Return the average of samples of a type."""
    means = np.stack([b.mean for b in samples])
    covariance = np.mean([b.covariance for b in samples], axis=0) + np.cov(means.T)
    tau, omega = (np.mean([getattr(b, n) for b in samples], axis=0) for n in ("tau", "omega"))
    return Type(means.mean(axis=0), covariance, tau, omega)


def _arms(data: Information, type_: Type, samples: Sequence[Type], usual: float) -> list[ArmFit]:
    mean, covariance, shrinkage = _arm_posteriors(data, samples)
    share = 1 - np.clip(np.einsum("aii->ai", shrinkage), 0, 1)
    drift, drift_std = _drifts(data, type_)
    beside = (mean - type_.mean) / np.sqrt(type_.tau)
    return [
        ArmFit(
            np.maximum(mean[a], 0) * usual, covariance[a] * usual**2, share[a], beside[a],
            drift[a] * usual, drift_std[a] * usual,
        )
        for a in range(data.arms)
    ]  # fmt: skip


def _arm_posteriors(data: Information, samples: Sequence[Type]) -> tuple[Array, Array, Array]:
    """Return means, covariances and shares of the type, averaged over samples of the type."""
    each = [arm_posterior(data, b) for b in samples]
    means = np.stack([e[0] for e in each])
    off = means - means.mean(axis=0)
    between = np.einsum("bai,baj->aij", off, off) / len(each)
    covariance = np.mean([e[1] for e in each], axis=0) + between
    return means.mean(axis=0), covariance, np.mean([e[2] for e in each], axis=0)


def _drifts(data: Information, type_: Type) -> tuple[Array, Array]:
    """Return slope and 1 sigma (A, p) of each flexibility over the sessions, one at a time."""
    J, k = marginalised(data.M, type_.omega, data.k)
    t = data.order
    J0, J1, J2 = (data.summed(J * (t**i)[:, None, None]) for i in range(3))
    k0, k1 = (data.summed(k * (t**i)[:, None]) for i in range(2))
    V = np.linalg.inv(J0 + np.diag(1 / type_.tau))
    level = np.einsum("aij,aj->ai", V, k0 + type_.mean / type_.tau)
    information = np.einsum("ajj->aj", J2) - np.einsum("aij,aik,akj->aj", J1, V, J1)
    score = k1 - np.einsum("aij,ai->aj", J1, level)
    enough = np.bincount(data.arm, minlength=data.arms)[:, None] >= 3
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(enough & (information > 1e-12), score / information, np.nan)
        std = np.where(np.isfinite(slope), 1 / np.sqrt(information), np.nan)
    return slope, std


def _sessions(
    data: Information, type_: Type, evidence: Sequence[Evidence], noise: Array, usual: float
) -> list[SessionFit]:
    mean, covariance, _ = arm_posterior(data, type_)
    without = _arm_without(data, type_)
    fits = []
    for s, one in enumerate(evidence):
        M, arm = data.M[s], int(data.arm[s])
        W = np.linalg.inv(np.eye(len(M)) + type_.omega[:, None] * M) * type_.omega
        d = W @ (data.k[s] - M @ mean[arm])
        own, rest = mean[arm] + d, np.eye(len(M)) - W @ M
        residual = one.matrix @ (own * usual) - one.right
        squares = float(residual @ residual) + one.squares
        typical = float(np.median(noise))
        rows = one.freedom + np.linalg.matrix_rank(one.matrix)
        fits.append(SessionFit(
            own * usual, np.sqrt(np.diag(W + rest @ covariance[arm] @ rest.T)) * usual,
            float(np.sqrt(noise[s])), np.maximum(without[s], 0) * usual,
            squares / max(rows * typical, 1e-300),
        ))  # fmt: skip
    return fits


def _arm_without(data: Information, type_: Type) -> Array:
    """Return each session's arm (S, p) by its other sessions."""
    J, k = marginalised(data.M, type_.omega, data.k)
    J, k = data.summed(J)[data.arm] - J, data.summed(k)[data.arm] - k
    shrinkage = np.linalg.inv(np.eye(len(type_.mean)) + type_.tau[:, None] * J)
    return np.asarray(np.einsum("sij,sj->si", shrinkage, type_.mean + type_.tau * k))


def draws(data: Information, begin: Type, centre: Array) -> list[Type]:
    """Return samples of the type from the posterior of its scatters, each with its mean."""
    rng = np.random.default_rng(0)
    repeated = len(data.arm) > data.arms
    size, known = scatter_scale(begin), identifiable(begin.covariance)
    type_ = begin
    shared = float(np.mean((begin.tau / size**2)[known])) if known.any() else INITIAL_SCATTER**2
    kept = []
    for iteration in range(BURN_IN + SAMPLES * THINNING):
        delta, d = _draw_effects(data, type_, rng)
        relative = np.sum((delta / size) ** 2, axis=0)
        tau = (SPREAD_WEIGHT * shared + relative) / rng.chisquare(
            SPREAD_WEIGHT + data.arms, len(size)
        )  # fmt: skip
        tau = np.clip(tau, MIN_SCATTER**2, MAX_SCATTER**2)
        shared = _draw_shared(tau[known], rng) if known.any() else shared
        tau = np.where(known, tau, shared)
        omega = type_.omega
        if repeated:
            total = SESSION_WEIGHT * (0.2 * INITIAL_SCATTER) ** 2 + np.sum(
                (d / size)[:, known] ** 2
            )
            freedom = SESSION_WEIGHT + len(data.arm) * int(known.sum())
            scale = np.clip(total / rng.chisquare(freedom), MIN_SCATTER**2, MAX_SCATTER**2)
            omega = scale * size**2
        type_ = with_mean(data, tau * size**2, omega, centre)
        if iteration >= BURN_IN and (iteration - BURN_IN) % THINNING == 0:
            kept.append(type_)
    return kept


def _draw_shared(tau: Array, rng: Generator) -> float:
    """Draw the relative variance shared by all flexibilities, from its gamma conditional."""
    shape = 0.5 * SPREAD_WEIGHT * len(tau)
    rate = 0.5 * SPREAD_WEIGHT * float(np.sum(1 / tau))
    return float(np.clip(rng.gamma(shape) / rate, MIN_SCATTER**2, MAX_SCATTER**2))


def _draw_effects(data: Information, type_: Type, rng: Generator) -> tuple[Array, Array]:
    """Draw the deviations of arms from their type (A, p) and of sessions from their arm (S, p)."""
    p = len(type_.mean)
    mean = type_.mean + np.linalg.cholesky(type_.covariance) @ rng.normal(size=p)
    J, k = marginalised(data.M, type_.omega, data.k)
    J, k = data.summed(J), data.summed(k)
    delta = _draw_normal(J, k - J @ mean, type_.tau, rng)
    residual = data.k - np.einsum("sij,sj->si", data.M, (mean + delta)[data.arm])
    return delta, _draw_normal(data.M, residual, type_.omega, rng)


def _draw_normal(M: Array, k: Array, variance: Array, rng: Generator) -> Array:
    """Draw x (N, p) from its posterior: prior N(0, variance), information M, right side k."""
    root = np.sqrt(variance)
    precision = np.eye(len(variance)) + root[:, None] * M * root
    L = np.linalg.cholesky(precision)
    right = (root * k)[..., None]
    noise = rng.normal(size=right.shape)
    # precision x = right + L noise has the mean and the covariance that are wanted
    return np.asarray(root * np.linalg.solve(precision, right + L @ noise)[..., 0])


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
