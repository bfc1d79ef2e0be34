"""The compliance of a fleet: flexibilities of a type, of its arms, of their sessions.

An arm's flexibilities scatter about its type's, a session's about its arm's; both scatters, the
noise and the type's values are estimated from the whole fleet (empirical Bayes: Efron, Morris, J.
Am. Stat. Assoc. 70 (1975) 311; by EM: Dempster, Laird, Rubin, J. R. Stat. Soc. B 39 (1977) 1), so
that an arm with few poses is drawn to its type where its own data say little. Everything is normal
and linear: of a session only its normal matrix is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from core.hierarchy_evidence import Evidence

Array = NDArray[np.float64]
ROUNDS = 400
SETTLED = 1e-5  # relative change of every scatter at which it has come to rest
MOST = 400  # arms from which scatters are estimated: more tell hardly more
NOISE_WEIGHT = 10.0  # coordinates that the type's noise counts for beside a session's own
SPREAD_WEIGHT = 3.0  # arms that the scatter of all joints counts for beside a joint's own
WEAK = 0.1  # of a type's values, per usual flexibility: what no session shows stays at the nominal
VAGUE = 0.3  # share of that sigma: a value that is known no better is not shown
BEGIN = 0.3  # relative scatter of arms to begin with
SMALLEST, LARGEST = 0.01, 2.0  # relative scatters that are believed


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
    surprise: float  # how badly it fits its arm: chi-squared over its freedom


@dataclass(frozen=True)
class TypeFit:
    """All arms of one type."""

    scatter: Scatter
    arms: tuple[ArmFit, ...]
    sessions: tuple[SessionFit, ...]


@dataclass(frozen=True)
class _Data:
    """Sessions in units of the usual flexibility and of their own noise."""

    M: Array  # (S, p, p) information of a session
    k: Array  # (S, p)
    arm: NDArray[np.int64]  # (S,)
    arms: int
    order: Array  # (S,) number of the session within its arm, from its arm's mean

    def of(self, arms: NDArray[np.int64]) -> _Data:
        """Return some of the arms, numbered anew."""
        number = np.full(self.arms, -1)
        number[arms] = np.arange(len(arms))
        kept = number[self.arm] >= 0
        return _Data(
            self.M[kept], self.k[kept], number[self.arm[kept]], len(arms), self.order[kept]
        )

    def summed(self, values: Array) -> Array:
        """Return the sums over the sessions of each arm."""
        total = np.zeros((self.arms, *values.shape[1:]))
        np.add.at(total, self.arm, values)
        return total


@dataclass(frozen=True)
class _Type:
    """What is estimated of a type, in units of the usual flexibility."""

    mean: Array  # (p,)
    covariance: Array  # (p, p)
    tau: Array  # (p,) variance between arms
    omega: Array  # (p,) variance between sessions of an arm


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
    found = _estimated(chosen, centre)
    if chosen is not data:
        found = _with_mean(data, found.tau, found.omega, centre)
    typical = float(np.sqrt(np.median(noise)))
    scatter = Scatter(
        found.mean * usual, found.covariance * usual**2, np.sqrt(found.tau) * usual,
        np.sqrt(found.omega) * usual, typical, data.arms, len(sessions), shown(found.covariance),
    )  # fmt: skip
    return TypeFit(
        scatter, tuple(_arms(data, found, usual)),
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
) -> _Data:
    R = np.stack([s.matrix for s in sessions]) * usual
    right = np.stack([s.right for s in sessions])
    M = np.swapaxes(R, 1, 2) @ R / noise[:, None, None]
    k = np.einsum("sij,si->sj", R, right) / noise[:, None]
    order = np.zeros(len(arm))
    for number in np.unique(arm):
        at = np.flatnonzero(arm == number)
        order[at] = np.arange(len(at)) - (len(at) - 1) / 2
    return _Data(M, k, arm, int(arm.max()) + 1, order)


def _through(M: Array, variance: Array, *values: Array) -> list[Array]:
    """Return (I + M diag(variance))^-1 times M and further vectors: what is left of information.

    Passing on what is known of x to x - d, where d has this variance.
    """
    p = M.shape[-1]
    root = np.eye(p) + M * variance
    columns = np.concatenate([M, *(v[..., None] for v in values)], axis=-1)
    found = np.linalg.solve(root, columns)
    return [found[..., :p], *(found[..., p + i] for i in range(len(values)))]


def _with_mean(data: _Data, tau: Array, omega: Array, centre: Array) -> _Type:
    """Return the type with its mean, for given scatters."""
    J, k = _through(data.M, omega, data.k)
    P, r = _through(data.summed(J), tau, data.summed(k))
    held = WEAK**2 * np.eye(len(centre))
    covariance = np.linalg.inv(P.sum(axis=0) + held)
    mean = covariance @ (r.sum(axis=0) + WEAK**2 * centre)
    return _Type(mean, (covariance + covariance.T) / 2, tau, omega)


def _estimated(data: _Data, centre: Array) -> _Type:
    """Return the type with its scatters, by EM."""
    p = len(centre)
    now = _with_mean(data, np.ones(p), np.zeros(p), centre)
    repeated = len(data.arm) > data.arms
    size = _size(now)
    tau = (BEGIN * size) ** 2
    omega = (0.2 * BEGIN * size) ** 2 if repeated else np.zeros(p)
    for _ in range(ROUNDS):
        now = _with_mean(data, tau, omega, centre)
        size, seen = _size(now), shown(now.covariance)
        between, within = _expected(data, now)
        new_tau = _held(between / data.arms / size**2, tau / size**2, seen, data.arms) * size**2
        # of sessions one number is estimated: few arms have enough of them for more
        new_omega = _shared(within / len(data.arm) / size**2, seen) * size**2 * repeated
        change = np.abs(np.log(new_tau / tau)).max()
        if repeated:
            change = max(change, float(np.abs(np.log(new_omega / omega)).max()))
        tau, omega = new_tau, new_omega
        if change < SETTLED:
            break
    return _with_mean(data, tau, omega, centre)


def _size(now: _Type) -> Array:
    """Return the flexibilities that scatters are shares of."""
    return np.maximum(np.abs(now.mean), 0.1)


def shown(covariance: Array) -> NDArray[np.bool_]:
    """Return which of a type's flexibilities any session shows, in units of the usual one."""
    return np.asarray(np.sqrt(np.diag(covariance)) < VAGUE / WEAK)


def _shared(relative: Array, seen: NDArray[np.bool_]) -> float:
    """Return the relative variance that all flexibilities share."""
    found = float(np.mean(relative[seen])) if seen.any() else BEGIN**2
    return min(max(found, SMALLEST**2), LARGEST**2)


def _held(relative: Array, before: Array, seen: NDArray[np.bool_], arms: int) -> Array:
    """Return relative variances (p,), held by the one that all share."""
    shared = _shared(before, seen)
    found = (SPREAD_WEIGHT * shared + arms * relative) / (SPREAD_WEIGHT + arms)
    return np.where(seen, np.clip(found, SMALLEST**2, LARGEST**2), shared)


def _expected(data: _Data, now: _Type) -> tuple[Array, Array]:
    """Return the expected sums of squares (p,) between arms, and between sessions of an arm."""
    mean, covariance, own = _arm_posterior(data, now)
    J, k = _through(data.M, now.omega, data.k)
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


def _arm_posterior(data: _Data, now: _Type) -> tuple[Array, Array, Array]:
    """Return the arms' means (A, p), covariances (A, p, p), and shares of the type (A, p, p)."""
    J, k = _through(data.M, now.omega, data.k)
    J, k = data.summed(J), data.summed(k)
    own = np.linalg.inv(np.eye(len(now.mean)) + J * now.tau).swapaxes(1, 2)  # (I + T J)^-1
    V = now.tau[:, None] * own.swapaxes(1, 2)
    V = (V + V.swapaxes(1, 2)) / 2
    mean = np.einsum("aij,aj->ai", V, k) + own @ now.mean
    covariance = V + own @ now.covariance @ own.swapaxes(1, 2)
    return mean, np.asarray(covariance), own.swapaxes(1, 2)


def _arms(data: _Data, now: _Type, usual: float) -> list[ArmFit]:
    mean, covariance, own = _arm_posterior(data, now)
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


def _drifts(data: _Data, now: _Type) -> tuple[Array, Array]:
    """Return slope and 1 sigma (A, p) of each flexibility over the sessions, one at a time."""
    J, k = _through(data.M, now.omega, data.k)
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
    data: _Data, now: _Type, given: Sequence[Evidence], noise: Array, usual: float
) -> list[SessionFit]:
    mean, covariance, _ = _arm_posterior(data, now)
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
            float(np.sqrt(noise[s])), squares / max(rows * typical, 1e-300),
        ))  # fmt: skip
    return found
