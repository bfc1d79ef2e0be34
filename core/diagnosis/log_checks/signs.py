"""Log checks for forces of the wrong sign, without one or in the wrong axes (docs/conventions.md).

An arm deflects in the direction of a force, and a sensor measures it. If the data agree much better
with the force reversed, or in tool axes, the column has another convention.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.criteria import MAX_SHARE_WITH_OTHER_SIGN
from gapbridge.core.dynamics import predict_torque, predict_wrench
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.least_squares import bounded
from gapbridge.core.estimation.registration import frame_columns, register_robustly
from gapbridge.core.estimation.robust import start_weights
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion

MAX_ROWS = 200  # that are checked, evenly spaced
MIN_ROWS = 6  # with a force, for a sign to be checked
MIN_FORCE = 1.0  # N, Nm
ROUNDS = 4
MIN_JOINTS_UNSIGNED = 3  # that turn both ways: weights alone hold two at one sign
MIN_SHARE_EACH_WAY = 0.05  # of the rows
SENSORS = {
    "ft_raw_wrench": LogCheck.WRENCH_SIGN,
    "actual_current_as_torque": LogCheck.TORQUE_SIGN,
}


def sign_findings(model: Model, log: Log) -> list[LogFinding]:
    """Return findings on forces that look reversed or in other axes."""
    q = log.get("actual_q", "target_q")
    if q is None:
        return []
    findings = [LogFinding(LogCheck.TORQUE_UNSIGNED)] if _is_unsigned(log, q) else []
    for name, check in SENSORS.items():
        checked = name == "ft_raw_wrench" or model.arm.mass.any()
        if checked and _is_reversed(model, log, q, name):
            findings.append(LogFinding(check))
    findings = findings or _sensor_axes(model, log, q)
    pull = log.get("actual_TCP_force")
    if pull is None or findings:
        return findings
    for find in (_by_deflection, *(_by_sensor(name) for name in SENSORS)):
        convention = find(model, log, q, pull)
        if convention is not None:
            return [LogFinding(convention)]
    return []


def checked_rows(q: Array, *columns: Array | None) -> Index:
    """Return at most MAX_ROWS rows, evenly spaced, in which all columns (N, k) are finite."""
    good = np.isfinite(q).all(axis=1)
    for column in columns:
        if column is not None:
            good &= np.isfinite(column).all(axis=1)
    rows = np.flatnonzero(good)
    take = np.linspace(0, max(len(rows) - 1, 0), MAX_ROWS).astype(int)
    return rows[np.unique(take)] if len(rows) else rows


def loads_with(log: Log, rows: Index, pull: Array | None) -> Loads:
    """Return the loads in some rows, with a pull (k, 6) on the tool; the cell's where not known."""

    def some(name: str) -> Array | None:
        column = log.get(name)
        return None if column is None or not np.isfinite(column).all() else column[rows]

    return Loads(payload_mass=some("payload"), payload_cog=some("payload_cog"), wrench=pull)


def _variants(model: Model, q: Array, pull: Array) -> dict[LogCheck | None, Array]:
    """Return the possible conventions of the external force; None: that of a log."""
    tool_axes = model.rigid_pose(q).rotation
    in_tool = np.hstack(
        [(tool_axes @ part[..., None])[..., 0] for part in (pull[:, :3], pull[:, 3:])]
    )
    return {
        None: pull,
        LogCheck.PULL_SIGN: -pull,
        LogCheck.PULL_IN_TOOL: in_tool,
        LogCheck.PULL_SIGN_IN_TOOL: -in_tool,
    }


def _best(residual: dict[LogCheck | None, float]) -> LogCheck | None:
    """Return the convention with a much smaller residual than that of a log, or None."""
    least = min(residual, key=lambda key: residual[key])
    return least if residual[least] < MAX_SHARE_WITH_OTHER_SIGN * residual[None] else None


def _by_deflection(model: Model, log: Log, q: Array, pull: Array) -> LogCheck | None:
    """Return the finding on the force by the deflection of the measured positions."""
    measured = log.get("measured_position")
    if measured is None:
        return None
    rows = checked_rows(q, measured, pull)
    pulled = np.abs(pull[rows]).max(axis=1, initial=0.0) > MIN_FORCE
    if pulled.sum() < MIN_ROWS or 3 * len(rows) < 2 * (3 * model.arm.n + 6):
        return None
    residual = {}
    try:
        for check, variant in _variants(model, q[rows], pull[rows]).items():
            off = _compliance_residual(
                model, q[rows], measured[rows], loads_with(log, rows, variant)
            )
            residual[check] = float(np.median(np.linalg.norm(off[pulled], axis=1)))
    except InputError:
        return None
    return _best(residual)


def _compliance_residual(model: Model, q: Array, measured: Array, loads: Loads) -> Array:
    """Return the residual positions (N, 3) of a robust fit of non-negative flexibilities."""
    predicted = model.predict(q, loads).position
    in_base = register_robustly(measured, predicted).in_base(measured)
    form, n = model.linear_form(q, loads), model.arm.n
    free = np.concatenate([form.jacobian[:, :3], frame_columns(in_base)[:, :3]], axis=2)
    A = np.concatenate([form.regressor[:, :3], free], axis=2).reshape(3 * len(q), -1)
    b = (in_base - predicted).ravel()
    lower = np.concatenate([-np.concatenate(model.compliance()), np.full(n + 6, -np.inf)])
    weight, off = np.ones(len(b)), in_base - predicted
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        x = bounded(A * root[:, None], b * root, lower, np.full(len(lower), np.inf))[0]
        off = (b - A @ x).reshape(-1, 3)
        weight = np.repeat(start_weights(off), 3)
    return off


def _predicted(
    model: Model, log: Log, q: Array, name: str, pull: Array | None, rows: Index
) -> Array:
    """Return the prediction of a channel at rest; accelerations matter little to a sign."""
    predictor = predict_wrench if name == "ft_raw_wrench" else predict_torque
    motion = Motion.at_rest(q[rows], loads_with(log, rows, pull))
    return predictor(replace(model, terms=()), motion)


def spread_of(values: Array) -> float:
    """Return the median distance of values (N, k) from their median."""
    return float(np.median(np.linalg.norm(values - np.median(values, axis=0), axis=1)))


def _by_sensor(name: str) -> Callable[[Model, Log, Array, Array], LogCheck | None]:
    """Return the check of a force by the readings of a sensor."""

    def find(model: Model, log: Log, q: Array, pull: Array) -> LogCheck | None:
        column = log.get(name)
        if column is None or (name != "ft_raw_wrench" and not model.arm.mass.any()):
            return None
        rows = checked_rows(q, column, pull)
        pulled = rows[np.abs(pull[rows]).max(axis=1, initial=0.0) > MIN_FORCE]
        if len(pulled) < MIN_ROWS:
            return None
        spread = {}
        for check, variant in _variants(model, q[pulled], pull[pulled]).items():
            predicted = _predicted(model, log, q, name, variant, pulled)
            spread[check] = spread_of(column[pulled] - predicted)
        return _best(spread)

    return find


def _is_unsigned(log: Log, q: Array) -> bool:
    """Return whether torques are sizes: none is negative, whichever way the joints turn."""
    torque = log.get("actual_current_as_torque")
    if torque is None or len(q) < MIN_ROWS or not np.fmin.reduce(torque, axis=None) >= 0:
        return False
    step = np.diff(q, axis=0)
    turns = np.minimum((step > 0).mean(axis=0), (step < 0).mean(axis=0)) > MIN_SHARE_EACH_WAY
    pushed = np.fmax.reduce(torque, axis=0) > 0
    return int((turns & pushed).sum()) >= MIN_JOINTS_UNSIGNED


def _sensor_axes(model: Model, log: Log, q: Array) -> list[LogFinding]:
    """Return the finding on a force sensor of left-handed axes, or with torques before forces.

    Right-handed axes are a misalignment, which the diagnosis measures.
    """
    wrench, pull = log.get("ft_raw_wrench"), log.get("actual_TCP_force")
    rows = checked_rows(q, wrench, pull)
    if wrench is None or len(rows) < MIN_ROWS:
        return []
    read = wrench[rows]
    load = None if pull is None else pull[rows]
    force = _predicted(model, log, q, "ft_raw_wrench", load, rows)[:, :3]
    if spread_of(force) < MIN_FORCE:
        return []
    likely = MAX_SHARE_WITH_OTHER_SIGN * spread_of(read[:, :3] - force)
    if spread_of(read[:, 3:] - force) < likely:
        return [LogFinding(LogCheck.TORQUES_FIRST)]
    axes = [np.eye(3)[list(order)] * sign[:, None] for order in itertools.permutations(range(3))
            for sign in np.array(list(itertools.product((1.0, -1.0), repeat=3)))]  # fmt: skip
    left = {k: spread_of(read[:, :3] - force @ turn.T) for k, turn in enumerate(axes)}
    best = axes[min(left, key=lambda k: left[k])]
    if min(left.values()) > likely or np.linalg.det(best) > 0 or (best == -np.eye(3)).all():
        return []
    names = tuple("xyz"[int(np.argmax(np.abs(row)))] for row in best)
    signed = tuple(("-" if row.sum() < 0 else "") + n for row, n in zip(best, names, strict=True))
    return [LogFinding(LogCheck.LEFT_HANDED_WRENCH, signed)]


def _is_reversed(model: Model, log: Log, q: Array, name: str) -> bool:
    """Return whether a sensor itself has the opposite sign."""
    column = log.get(name)
    pull = log.get("actual_TCP_force")
    if column is None:
        return False
    rows = checked_rows(q, column, pull)
    if len(rows) < MIN_ROWS:
        return False
    expected = _predicted(model, log, q, name, None if pull is None else pull[rows], rows)
    nominal, reversed_ = (spread_of(sign * column[rows] - expected) for sign in (1.0, -1.0))
    return spread_of(expected) >= MIN_FORCE and reversed_ <= MAX_SHARE_WITH_OTHER_SIGN * nominal
