"""Log checks for mistakes of frames, axes, signs and rows, by the measured poses.

Errors of an arm are millimetres. If poses are off by centimetres, a frame, an axis, a sign or a row
is wrong; the correction that makes measured and predicted poses agree identifies the mistake.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.criteria import (
    MAX_ARM_ERROR,
    MAX_RATIO_TO_BEST,
    MAX_SHARE_AFTER_CORRECTION,
)
from gapbridge.core.diagnosis.log_checks.kinematics import (
    best_order,
    inverted,
    measured_point,
    other_arms,
    other_models,
)
from gapbridge.core.diagnosis.log_checks.signs import checked_rows, spread_of
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.registration import register_robustly
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix, rotation_vector

MIN_ROWS = 6


def frame_findings(model: Model, log: Log, metrology: Metrology) -> list[LogFinding]:
    """Return the findings on the frames of the measured poses."""
    measured = log.get("measured_position")
    q = log.get("actual_q") if log.has("actual_q") else log.get("target_q")
    if measured is None or q is None:
        return []
    rows = checked_rows(q, measured)
    if len(rows) < MIN_ROWS:
        return []
    try:
        predicted = model.rigid_pose(q[rows]).position
    except InputError:
        return []
    positions = measured[rows]
    distance = _median_distance(positions, predicted)
    findings = []
    if distance > MAX_ARM_ERROR:
        findings.append(
            _position_finding(model, q, measured, rows, distance, log.get("measured_rotation"))
        )
    elif metrology.registered:
        offset = float(np.median(np.linalg.norm(positions - predicted, axis=1)))
        if offset > MAX_ARM_ERROR and distance < MAX_SHARE_AFTER_CORRECTION * offset:
            findings.append(LogFinding(LogCheck.NOT_IN_BASE, (offset,)))
    rotations = log.get("measured_rotation")
    if rotations is not None and not findings:
        findings += _rotations(model, q[rows], positions, rotations[rows], metrology)
    return findings


def _median_distance(measured: Array, predicted: Array) -> float:
    """Return the median distance (m) in the best-fit frame."""
    frame = register_robustly(measured, predicted)
    return float(np.median(np.linalg.norm(frame.in_base(measured) - predicted, axis=1)))


def _position_finding(
    model: Model, q: Array, measured: Array, rows: Index, distance: float, rotations: Array | None
) -> LogFinding:
    """Return the finding on positions that do not agree with the arm."""
    others = ((mistake, arm, q[rows], measured[rows]) for mistake, arm in other_arms(model))
    # other arms only if no mistake with this arm explains it
    for tried in (_mistakes(model, q, measured, rows, rotations), others):
        best, identified = distance, None
        for mistake, trial_model, trial_q, trial in tried:
            if len(trial) < MIN_ROWS:
                continue
            error = _median_distance(trial, trial_model.rigid_pose(trial_q).position)
            if error < MAX_RATIO_TO_BEST * best:
                best, identified = error, mistake
        if identified is not None and best < MAX_SHARE_AFTER_CORRECTION * distance:
            return LogFinding(LogCheck.POSITIONS_OFF_BY, (distance, identified, best))
    return LogFinding(LogCheck.POSITIONS_OFF, (distance,))


def _mistakes(
    model: Model, q: Array, measured: Array, rows: Index, rotations: Array | None
) -> Iterator[tuple[LogFinding, Model, Array, Array]]:
    """Yield each mistake with the model, joint angles and positions that correct it."""
    positions = measured[rows]
    mirrored = positions * [1.0, 1.0, -1.0]
    yield LogFinding(LogCheck.MIRRORED), model, q[rows], mirrored
    for joint in range(q.shape[1]):
        flipped = q[rows].copy()
        flipped[:, joint] *= -1
        yield LogFinding(LogCheck.JOINT_SIGN, (joint + 1,)), model, flipped, positions
    for step, check in ((1, LogCheck.ROW_LATE), (-1, LogCheck.ROW_EARLY)):
        inside = rows[(rows + step >= 0) & (rows + step < len(q))]
        inside = inside[np.isfinite(measured[inside + step]).all(axis=1)]
        yield LogFinding(check), model, q[inside], measured[inside + step]
    predicted = model.rigid_pose(q[rows]).position
    size = spread_of(positions) / max(spread_of(predicted), 1e-9)
    for unit, factor in (("centimetres", 100.0), ("inches", 1 / 0.0254), ("feet", 1 / 0.3048)):
        if 0.82 < size / factor < 1.22:
            yield LogFinding(LogCheck.LENGTH_UNIT, (unit,)), model, q[rows], positions / factor
    for mistake, other in other_models(model):
        yield mistake, other, q[rows], positions
    point = measured_point(model, q[rows], positions)
    if point is not None:
        yield point[0], point[1], q[rows], positions
    order = best_order(model, q[rows], positions)
    if order is not None:
        yield order[0], model, order[1], positions
    rotation = None if rotations is None else rotations[rows]
    if rotation is None or not np.isfinite(rotation).all():
        rotation = rotation_vector(np.swapaxes(model.rigid_pose(q[rows]).rotation, 1, 2))
    yield LogFinding(LogCheck.INVERTED), model, q[rows], inverted(positions, rotation)


def _rotations(
    model: Model, q: Array, positions: Array, rotations: Array, metrology: Metrology
) -> list[LogFinding]:
    good = np.isfinite(rotations).all(axis=1)
    if good.sum() < MIN_ROWS:
        return []
    q, positions, rotations = q[good], positions[good], rotations[good]
    poses = model.rigid_pose(q)
    frame = register_robustly(positions, poses.position)
    base = np.eye(3) if metrology.registered else frame.rotation
    error, constant = _rotation_error(poses.rotation, base, rotation_matrix(rotations))
    if error > 10 * MAX_ARM_ERROR:
        if _rotation_error(poses.rotation, base, _roll_pitch_yaw(rotations))[0] < MAX_ARM_ERROR:
            return [LogFinding(LogCheck.ROLL_PITCH_YAW)]
        return [LogFinding(LogCheck.ROTATIONS_OFF, (error,))]
    return [LogFinding(LogCheck.TARGET_AXES, (constant,))] if constant > 10 * MAX_ARM_ERROR else []


def _rotation_error(predicted: Array, base: Array, measured: Array) -> tuple[float, float]:
    """Return the median difference (rad) of rotations beyond a constant one, and that one."""
    off = np.swapaxes(predicted, 1, 2) @ base.T @ measured
    U, _, Vt = np.linalg.svd(off.sum(axis=0))
    mean = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    error = np.linalg.norm(rotation_vector(mean.T @ off), axis=1)
    return float(np.median(error)), float(np.linalg.norm(rotation_vector(mean)))


def _roll_pitch_yaw(angles: Array) -> Array:
    x, y, z = (rotation_matrix(angles[:, k, None] * np.eye(3)[k]) for k in range(3))
    return np.asarray(z @ y @ x)
