"""Log checks for mistakes of units, column names and clocks, made before anything is fitted.

Checks that need a prediction (frames, signs, other kinematics) are in the other modules.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LogError
from gapbridge.core.log.columns import COLUMNS, misspelt
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.motion import MAX_SAMPLE_TIME, time_finding

MAX_ANGLE = 25.0  # rad: larger joint angles are degrees
MIN_LIMIT = 7.0  # rad: a little more than one turn, which any encoder may report
OVER_LIMIT = 1.5  # times a joint's limit: larger angles are degrees
MAX_REACHES = 50.0  # times the arm's reach from the middle: larger positions are millimetres
MAX_COG_REACHES = 3.0  # times the arm's reach, for a payload's centre of gravity
OVERLOAD = 10.0  # times the rated payload (or the arm's own weight): grams
MAX_TEMPERATURE = 200.0  # °C: larger values are kelvin
FAHRENHEIT_FROM = 95.0  # °C: arms stop before
MAX_ROTATION = 2 * np.pi + 0.3  # rad, of a rotation vector
MIN_SPEED = 0.05  # rad/s, from which a joint's travel gives the time that it took
MIN_STEPS = 20  # of a joint at such a speed, to determine the unit of the times
TIME_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}  # s
MIN_POSES = 15
AT_ONCE = 1000  # rows
READINGS = (
    "measured_position", "measured_rotation", "ft_raw_wrench", "actual_current_as_torque",
)  # fmt: skip


def check_units(model: Model, log: Log) -> None:
    """Raise LogError if a column's values can only be in another unit.

    Joints or rotations in degrees, positions or centres of gravity in millimetres, payloads in
    grams, temperatures in kelvin, times in fractions of a second; also for an infinite joint
    angle, with its row.
    """
    for name in ("actual_q", "target_q"):
        _check_angles(model, log, name)
    _check_positions(model, log)
    _check_times(log)
    reach = _reach(model)
    heaviest, largest_cog = OVERLOAD * _usual_load(model), MAX_COG_REACHES * reach + 1
    for name, most, what in (
        ("measured_rotation", MAX_ROTATION, "the rotation vectors look like degrees, expected rad"),
        ("payload", heaviest, "the payload looks like grams, expected kg"),
        ("payload_cog", largest_cog, "the centre of gravity looks like mm, expected m"),
        ("joint_temperatures", MAX_TEMPERATURE, "the temperatures look like kelvin, expected °C"),
    ):
        column = log.get(name)
        if column is None:
            continue
        rows = column.reshape(len(column), -1)
        if _within(rows, most / np.sqrt(rows.shape[1])) or not np.isfinite(rows).any():
            continue
        size = (
            np.linalg.norm(rows, axis=1)
            if name == "measured_rotation"
            else np.abs(rows).max(axis=1)
        )
        if not (size > most).any():
            continue
        # not single typing errors: three quarters of the nonzero values have to be too large
        high = size[np.isfinite(size) & (size != 0)]
        worst = float(np.quantile(high, 0.25)) if len(high) else 0.0
        if worst > most or (name == "measured_rotation" and _step_share(high > most) > 0.1):
            label = name if column.ndim == 1 else f"{name}_*"
            raise LogError(f"{log.path}: column {label}: found about {worst:.4g}; {what}")


def _check_angles(model: Model, log: Log, name: str) -> None:
    q = log.get(name)
    limits = model.arm.limits
    widest = OVER_LIMIT * np.maximum(np.abs(limits.lower), np.abs(limits.upper))
    most = np.clip(widest, MIN_LIMIT, MAX_ANGLE)
    if q is None or _within(q, float(most.min())) or not np.isfinite(q).any():
        return
    if np.isinf(q).any():
        log.require(name)
    worst = np.fmax.reduce(np.abs(q), axis=0)  # nan of a joint without a number
    if (worst > most).any():
        raise LogError(
            f"{log.path}: columns {name}_*: found values up to {worst.max():g}; the joint angles "
            "look like degrees, expected rad"
        )


def _check_positions(model: Model, log: Log) -> None:
    measured = log.get("measured_position")
    reach = _reach(model)
    if measured is None or _within(measured, MAX_REACHES * reach / np.sqrt(12)):
        return  # bounds every distance
    measured = measured[np.isfinite(measured).all(axis=1)]
    if not len(measured):
        return
    widest = measured.max(axis=0) - measured.min(axis=0)
    if np.linalg.norm(widest) <= MAX_REACHES * reach:  # bounds the median
        return
    spread = measured - np.median(measured, axis=0)
    size = float(np.median(np.linalg.norm(spread, axis=1)))
    if size > MAX_REACHES * reach:
        raise LogError(
            f"{log.path}: columns measured_position_*: found positions {size:g} apart for an arm "
            f"of {reach:.2f} m reach; the positions look like millimetres, expected m"
        )


def _check_times(log: Log) -> None:
    """Compare the steps of time with those that the joints' speeds need for their way.

    A log with such steps would count as poses at rest.
    """
    t, q, qd = (log.get(name) for name in ("timestamp", "actual_q", "actual_qd"))
    if t is None or q is None or qd is None or len(t) <= MIN_STEPS:
        return
    steps = np.diff(t)
    forward = np.flatnonzero(steps > 0)
    step = float(np.median(steps[forward])) if len(forward) else 0.0
    if step <= MAX_SAMPLE_TIME:
        return
    way, speed = np.abs(np.diff(q, axis=0))[forward], np.abs(qd[1:])[forward]
    known = (speed > MIN_SPEED) & np.isfinite(way) & np.isfinite(speed)
    if known.sum() < MIN_STEPS:
        return
    took = way[known] / speed[known]  # s
    shares = np.quantile(took / np.repeat(steps[forward], known.sum(axis=1)), (0.25, 0.75))
    for name, unit in TIME_UNITS.items():
        if unit / 2 < shares[0] and shares[1] < 2 * unit and step * unit <= MAX_SAMPLE_TIME:
            raise LogError(
                f"{log.path}: column timestamp: found rows about {step:.4g} apart while the joints "
                f"move as in {step * unit:.3g} s; the times look like {name}, expected s"
            )


def _within(values: Array, most: float) -> bool:
    """Return whether all values are finite and of at most this size."""
    return bool(-most <= values.min(initial=0.0) and values.max(initial=0.0) <= most)


def _reach(model: Model) -> float:
    return max(model.length, 0.05)


def _usual_load(model: Model) -> float:
    """Return the rated payload (kg), or the arm's own weight; infinite where neither is known."""
    own = float(model.arm.mass.sum())
    rated = model.arm.payload if np.isfinite(model.arm.payload) else (own or np.inf)
    return max(rated, model.payload_mass)


def _step_share(flags: NDArray[np.bool_]) -> float:
    return float(np.mean(flags)) if len(flags) else 0.0


def findings(
    log: Log, model: Model | None = None, metrology: Metrology | None = None
) -> list[LogFinding]:
    """Return findings on a log that can still be used.

    With ``model`` also on joint limits, number of poses, frames and signs.
    """
    turned = [LogFinding(LogCheck.WHOLE_TURNS, (log.turned,))] if log.turned else []
    if log.wrong_speeds[0]:
        turned.append(LogFinding(LogCheck.WRONG_SPEEDS, log.wrong_speeds))
    listed = [*_names(log), *_times(log), *turned, *_gaps(log)]
    measured = log.get("measured_position")
    at_rest = False
    if measured is not None and len(measured) > 3 and np.isfinite(measured).any():
        width = np.fmax.reduce(measured, axis=0) - np.fmin.reduce(measured, axis=0)
        at_rest = float(np.nanmax(width)) < 1e-3
        if at_rest:
            listed.append(LogFinding(LogCheck.POSITIONS_AT_REST))
    warm = log.get("joint_temperatures")
    if warm is not None and np.isfinite(warm).any() and float(np.nanmedian(warm)) > FAHRENHEIT_FROM:
        listed.append(LogFinding(LogCheck.FAHRENHEIT))
    if model is None:
        return listed
    # imported here, because prediction only checks units
    from gapbridge.core.diagnosis.log_checks.commands import command_findings
    from gapbridge.core.diagnosis.log_checks.frames import frame_findings
    from gapbridge.core.diagnosis.log_checks.lags import lag_findings
    from gapbridge.core.diagnosis.log_checks.signs import sign_findings
    from gapbridge.core.diagnosis.log_checks.weights import weight_findings

    listed += [*_limits(model, log), *_poses(log), *command_findings(log)]
    if not at_rest:
        listed += frame_findings(model, log, metrology or Metrology())
    weights = weight_findings(model, log)
    signs = [s for s in sign_findings(model, log) if not weights or s.check != LogCheck.TORQUE_SIGN]
    return listed + weights + signs + lag_findings(model, log)


class ColumnsAndOrder:
    """Findings on a log given in pieces: misspelt columns, and rows that are not in time order.

    Both change loads and last motions without an error. The clock may restart at a new session.
    """

    def __init__(self) -> None:
        self._misspelt: list[LogFinding] = []
        self._backward: list[int] = []  # lines
        self._last: Array | None = None  # (1, 2) session and time of the last row

    def add(self, log: Log) -> None:
        """Check one more piece."""
        self._misspelt = _names(log)
        time = log.get("timestamp")
        if time is None:
            return
        session = log.get("session")
        rows = np.column_stack([np.zeros(len(time)) if session is None else session, time])
        known = rows if self._last is None else np.vstack([self._last, rows])
        step, first = np.diff(known, axis=0), len(rows) - len(known) + 1
        back = np.flatnonzero((step[:, 0] == 0) & (step[:, 1] < 0)) + first
        self._backward += [log.line(row) for row in back]
        self._last = rows[-1:]

    def findings(self) -> list[LogFinding]:
        """Return the findings on all pieces."""
        values = (len(self._backward), *self._backward[:1])
        backward = [LogFinding(LogCheck.BACKWARD_TIME, values)] if self._backward else []
        return self._misspelt + backward


def _names(log: Log) -> list[LogFinding]:
    """Return unknown columns whose name is similar to a known one."""
    absent = [name for name in COLUMNS if not log.has(name)]
    pairs = [misspelt([unknown], absent, log.n) for unknown in log.unknown]
    return [LogFinding(LogCheck.MISSPELT, pair) for pair in pairs if pair][:3]


def _times(log: Log) -> list[LogFinding]:
    t = log.get("timestamp")
    if t is None or len(t) < 2:
        return []
    moving = time_finding(log)
    if moving is not None:
        return [moving]
    listed, repeated = [], int(np.sum(np.diff(t) == 0))
    if repeated:
        listed.append(LogFinding(LogCheck.REPEATED_TIME, (repeated,)))
    back = np.flatnonzero(np.diff(t) < 0)
    if len(back):
        listed.append(LogFinding(LogCheck.BACKWARD_TIME, (len(back), log.line(back[0] + 1))))
    return listed


def _gaps(log: Log) -> list[LogFinding]:
    findings = []
    for name in READINGS:
        column = log.get(name)
        missing = 0 if column is None else int(np.sum(~np.isfinite(column).all(axis=1)))
        if missing:
            findings.append(LogFinding(LogCheck.NO_READING, (missing, name)))
    return findings


def _limits(model: Model, log: Log) -> list[LogFinding]:
    q = log.get("actual_q", "target_q")
    if q is None or not np.isfinite(q).any():
        return []
    limits = model.arm.limits
    low, high = np.fmin.reduce(q, axis=0), np.fmax.reduce(q, axis=0)
    out = (low < limits.lower - 0.05) | (high > limits.upper + 0.05)
    joints = tuple(int(j) + 1 for j in np.flatnonzero(out))
    return [LogFinding(LogCheck.BEYOND_LIMITS, (joints,))] if joints else []


def _poses(log: Log) -> list[LogFinding]:
    q = log.get("actual_q", "target_q")
    if q is None or not np.isfinite(q).all():
        return []
    few, rows = q[:0], 0
    while len(few) < MIN_POSES:
        if rows >= len(q):
            break
        more = q[rows : rows + AT_ONCE]
        few, rows = np.unique(np.vstack([few, np.round(more, 4)]), axis=0), rows + AT_ONCE
    count = len(few)
    return [LogFinding(LogCheck.FEW_POSES, (count,))] if count < MIN_POSES else []
