"""Identification: the joint flexibilities of an arm, from poses and loads.

Least squares on the paper's linear form (eq. 35), taken again at the deflected shape until it
settles (Gauss-Newton), with the instrument's frame estimated along. Rank is handled by a weak prior
instead of by luck: what the data do not say stays at the model's value and is named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from core.effects.effect import typical_moment
from core.errors import ExcitationError
from core.loads import Loads
from core.log import Log
from core.metrology import Metrology
from core.model import Model
from core.registration import IDENTITY, Registration, frame_columns, register_robustly
from core.rotation import rotation_matrix, rotation_vector

Array = NDArray[np.float64]
ROUNDS = 12
FOLDS = 5
WILD = 5.0  # standard deviations beyond which a reading counts as wild
CLOSE = 0.98  # correlation from which two flexibilities count as one combination


@dataclass(frozen=True)
class Identification:
    """Flexibilities found, what they rest on and how far they carry."""

    model: Model  # with the flexibilities in it
    axial: Array  # (n,) rad/Nm
    radial: Array  # (n,) rad/Nm
    std_axial: Array  # (n,) rad/Nm, 1 sigma
    std_radial: Array  # (n,) rad/Nm, 1 sigma
    covariance: Array  # (2n, 2n), axial then radial
    identifiable: NDArray[np.bool_]  # (2n,): the data say more than the prior
    combinations: tuple[str, ...]  # what the data cannot tell apart or do not show
    registration: Registration
    samples: int
    gap_rms: float  # m per coordinate, before, frame fitted
    remaining_rms: float  # m per coordinate, after, wild readings left out
    remaining_rms_held_out: float  # the same on poses that the fit did not see; nan: too few poses
    outliers: NDArray[np.int64]  # rows weighed down as wild
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Data:
    q: Array
    loads: Loads
    position: Array  # (N, 3) measured, instrument's frame
    rotation: Array | None  # (N, 3, 3)
    registered: bool

    def part(self, rows: NDArray[Any]) -> _Data:
        rotation = None if self.rotation is None else self.rotation[rows]
        return _Data(self.q[rows], self.loads[rows], self.position[rows], rotation, self.registered)


@dataclass(frozen=True)
class _Fit:
    flexibility: Array  # (2n,)
    frame: Registration
    covariance: Array  # (2n, 2n)
    weights: Array  # (N,)
    scale: Array  # (2,) m, rad: noise of one coordinate


def identify_compliance(
    model: Model,
    log: Log,
    metrology: Metrology | None = None,
    *,
    nonnegative: bool = True,
    prior_std: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Identification:
    """Return the 2n joint flexibilities that best explain the measured TCP poses of ``log``.

    ``prior_std`` (rad/Nm; default ten times a usual flexibility of an arm of this size; inf: none)
    keeps what the data do not show near the model's own value. ``nonnegative`` bounds every
    flexibility at zero. Raises LogError where needed columns are missing, ExcitationError where
    nothing in the log makes the joints bend.
    """
    metrology = metrology or Metrology()
    data, used = _data(log, metrology)
    if prior_std is None:
        prior_std = 1e-2 / typical_moment(model.arm)
    _require_excitation(model, data, metrology, prior_std)
    tell = progress or (lambda text: None)
    tell("fitting")
    fit = _fit(model, data, nonnegative, prior_std)
    tell("checking on held-out poses")
    held_out = _held_out_rms(model, data, nonnegative, prior_std)
    return _result(model, data, used, fit, held_out, prior_std)


def _data(log: Log, metrology: Metrology) -> tuple[_Data, NDArray[np.int64]]:
    q = log.require("actual_q", "target_q")
    measured = log.get("measured_position")
    if measured is None:
        log.require("measured_position")
    assert measured is not None
    rotation = log.get("measured_rotation")
    good = np.isfinite(measured).all(axis=1)
    if rotation is not None:
        good &= np.isfinite(rotation).all(axis=1)
    used = np.flatnonzero(good)
    matrix = None if rotation is None else rotation_matrix(rotation[used])
    loads = log.loads()[used]
    return _Data(q[used], loads, measured[used], matrix, metrology.registered), used


def _require_excitation(model: Model, data: _Data, metrology: Metrology, prior_std: float) -> None:
    n = model.arm.n
    unknown = 2 if data.registered else 8
    if 3 * len(data.q) < unknown:
        raise ExcitationError(
            f"found {len(data.q)} row(s) with measured positions, expected at least "
            f"{-(-unknown // 3)} to fit the compliance"
        )
    form = model.linear_form(data.q, data.loads).regressor[:, :3].reshape(-1, 2 * n)
    if not data.registered:
        position = model.predict(data.q, data.loads).position
        Q = np.linalg.qr(frame_columns(position)[:, :3].reshape(-1, 6))[0]
        form = form - Q @ (Q.T @ form)
    shown = np.linalg.norm(form, axis=0) * min(prior_std, 1e-2 / typical_moment(model.arm))
    if not (shown > 3 * metrology.sigma).any():
        weightless = not model.arm.mass.any() and data.loads.wrench is None
        reason = (
            "the arm's links have no mass in the cell, and no payload or pull is in the log"
            if weightless and not _any_payload(model, data)
            else "no payload, pull or pose in it changes a joint's moment enough to bend it visibly"
        )
        raise ExcitationError(
            f"nothing in the log excites the compliance: {reason}; expected poses under different "
            "payloads (payload) or pulls (actual_TCP_force)"
        )


def _any_payload(model: Model, data: _Data) -> bool:
    mass = data.loads.payload_mass
    return bool(model.payload_mass > 0 if mass is None else (mass > 0).any())


def _start(model: Model, data: _Data) -> Registration:
    if data.registered:
        return IDENTITY
    return register_robustly(data.position, model.predict(data.q, data.loads).position)


def _residual(model: Model, data: _Data, frame: Registration) -> tuple[Array, Array]:
    """Return measured minus predicted (N, 3 or 6) in base axes, and the predicted positions."""
    poses = model.predict(data.q, data.loads)
    gap = frame.in_base(data.position) - poses.position
    if data.rotation is None:
        return gap, poses.position
    turn = frame.rotation_in_base(data.rotation) @ np.swapaxes(poses.rotation, 1, 2)
    return np.hstack([gap, rotation_vector(turn)]), poses.position


def _fit(model: Model, data: _Data, nonnegative: bool, prior_std: float) -> _Fit:
    n = model.arm.n
    start = np.concatenate(model.compliance())
    flexibility, frame = start.copy(), _start(model, data)
    weights, scale = np.ones(len(data.q)), np.ones(2)
    covariance = np.zeros((2 * n, 2 * n))
    for _ in range(ROUNDS):
        bent = model.with_compliance(flexibility[:n], flexibility[n:])
        gap, position = _residual(bent, data, frame)
        weights, scale = _robust_weights(gap, data, position)
        k = gap.shape[1]
        per_cell = np.sqrt(weights)[:, None] / np.repeat(scale, 3)[None, :k]
        A = (bent.linear_form(data.q, data.loads).regressor[:, :k] * per_cell[..., None]).reshape(
            -1, 2 * n
        )
        columns = frame_columns(position)[:, :k] * per_cell[..., None]
        F = np.zeros((A.shape[0], 0)) if data.registered else -columns.reshape(-1, 6)
        step, frame_step, covariance = _solve(
            A, F, (gap * per_cell).ravel(), flexibility, start, prior_std, nonnegative
        )
        flexibility = flexibility + step
        frame = frame.moved(frame_step) if len(frame_step) else frame
        if np.abs(step).max() < 1e-9 * max(np.abs(flexibility).max(), 1e-12):
            break
    return _Fit(flexibility, frame, covariance, weights, scale)


def _solve(
    A: Array, F: Array, b: Array, now: Array, start: Array, prior_std: float, nonnegative: bool
) -> tuple[Array, Array, Array]:
    """Return the step of the flexibilities, of the frame, and the flexibilities' covariance."""
    Q = np.linalg.qr(F)[0] if F.size else F
    # scaled by what data and prior say together: a column of rounding errors stays harmless
    norm = np.linalg.norm(A, axis=0)
    unit = 1 / np.sqrt(norm**2 + prior_std**-2 + (1e-9 * norm.max()) ** 2)
    clean = (A - Q @ (Q.T @ A)) * unit if F.size else A * unit
    right = b - Q @ (Q.T @ b) if F.size else b
    prior = unit / prior_std
    rows = np.vstack([clean, np.diag(prior)])
    rhs = np.concatenate([right, (start - now) / prior_std])
    if nonnegative:
        result = lsq_linear(rows, rhs, bounds=(-now / unit - 1e-300, np.inf), method="bvls",
                            tol=1e-14)  # fmt: skip
        x = result.x
    else:
        x = np.linalg.lstsq(rows, rhs, rcond=1e-12)[0]
    step = x * unit
    frame_step = np.linalg.lstsq(F, b - A @ step, rcond=None)[0] if F.size else np.zeros(0)
    information = rows.T @ rows
    covariance = np.linalg.pinv(information, rcond=1e-14, hermitian=True)
    return step, frame_step, covariance * np.outer(unit, unit)


def _robust_weights(gap: Array, data: _Data, position: Array) -> tuple[Array, Array]:
    """Return weights (N,) (Tukey's biweight on wild rows) and the noise scale of each unit."""

    def spread(part: Array) -> float:
        middle = np.median(np.abs(part))
        return max(float(1.4826 * middle), 1e-12)

    scale = np.array([spread(gap[:, :3]), spread(gap[:, 3:]) if gap.shape[1] > 3 else 1.0])
    distance = np.linalg.norm(gap / np.repeat(scale, 3)[: gap.shape[1]], axis=1)
    limit = WILD * np.sqrt(gap.shape[1])
    weights = np.clip(1 - (distance / limit) ** 2, 0, 1) ** 2
    # below two deviations nothing is weighed down: clean data keep their full information
    weights = np.where(distance < 2 * np.sqrt(gap.shape[1]), 1.0, weights)
    return np.maximum(weights, 1e-12), scale


def pose_groups(q: Array, tolerance: float = 1e-3) -> NDArray[np.int64]:
    """Return a number per row (N,): rows within ``tolerance`` (rad) of each other share one."""
    groups = np.full(len(q), -1)
    count = 0
    for row in range(len(q)):
        if groups[row] < 0:
            close = (np.abs(q[row:] - q[row]).max(axis=1) < tolerance) & (groups[row:] < 0)
            groups[row:][close] = count
            count += 1
    return groups


def _held_out_rms(model: Model, data: _Data, nonnegative: bool, prior_std: float) -> float:
    groups = pose_groups(data.q[:2000]) if len(data.q) <= 2000 else np.arange(len(data.q))
    poses = int(groups.max()) + 1
    if poses < 2 * FOLDS:
        return float("nan")
    fold = np.random.default_rng(0).permutation(poses)[groups] % FOLDS
    n = model.arm.n
    left: list[Array] = []
    for k in range(FOLDS):
        fit = _fit(model, data.part(fold != k), nonnegative, prior_std)
        bent = model.with_compliance(fit.flexibility[:n], fit.flexibility[n:])
        left.append(_residual(bent, data.part(fold == k), fit.frame)[0][:, :3])
    gap = np.vstack(left)
    distance = np.linalg.norm(gap, axis=1)
    calm = distance < WILD * np.sqrt(3) * 1.4826 * np.median(np.abs(gap))
    return float(np.sqrt(np.mean(gap[calm] ** 2)))


def _result(
    model: Model, data: _Data, used: NDArray[np.int64], fit: _Fit, held_out: float, prior_std: float
) -> Identification:
    n = model.arm.n
    bent = model.with_compliance(fit.flexibility[:n], fit.flexibility[n:])
    gap, _ = _residual(bent, data, fit.frame)
    before, _ = _residual(model, data, _start(model, data))
    calm = fit.weights > 1e-6
    unknown = 2 * n + (0 if data.registered else 6)
    freedom = max(3 * int(calm.sum()) - unknown, 1)
    std = np.sqrt(np.diag(fit.covariance))
    identifiable = std < 0.3 * prior_std
    notes = []
    if not calm.all():
        notes.append(f"{int((~calm).sum())} wild reading(s) weighed down")
    at_zero = [_name(i, n) for i in np.flatnonzero((fit.flexibility <= 0) & identifiable)]
    if at_zero:
        notes.append(f"at their bound of zero: {', '.join(at_zero)}")
    return Identification(
        bent, fit.flexibility[:n], fit.flexibility[n:], std[:n], std[n:], fit.covariance,
        identifiable, _combinations(fit.covariance, identifiable, n), fit.frame, len(data.q),
        float(np.sqrt(np.mean(before[calm][:, :3] ** 2))),
        float(np.sqrt(np.sum(gap[calm][:, :3] ** 2) / freedom)),
        held_out, used[~calm], tuple(notes),
    )  # fmt: skip


def _name(i: int | np.integer[Any], n: int) -> str:
    return f"axial_compliance_{i + 1}" if i < n else f"radial_compliance_{i - n + 1}"


def _combinations(covariance: Array, identifiable: NDArray[np.bool_], n: int) -> tuple[str, ...]:
    told = [f"{_name(i, n)}: not shown by these data" for i in np.flatnonzero(~identifiable)]
    std = np.sqrt(np.diag(covariance))
    for i in np.flatnonzero(identifiable):
        for j in np.flatnonzero(identifiable):
            if j > i and std[i] > 0 and std[j] > 0:
                correlation = covariance[i, j] / (std[i] * std[j])
                if abs(correlation) > CLOSE:
                    what = "difference" if correlation > 0 else "sum"
                    told.append(
                        f"{_name(i, n)} and {_name(j, n)}: mostly their "
                        f"{'sum' if what == 'sum' else 'difference'} is known "
                        f"(correlation {correlation:+.3f})"
                    )
    return tuple(told)
