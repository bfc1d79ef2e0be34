"""Mistakes of frames, axes and rows, suspected by name where the measured poses are far off.

An arm errs by millimetres. Where poses are centimetres off, a frame, an axis, a sign or a row is
taken wrongly; the one change that brings measured and predicted poses together names the mistake.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gapbridge.core.arrays import Array
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
from gapbridge.core.diagnosis.log_checks.signs import spread_of
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.registration import register_robustly
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix, rotation_vector

MOST = 200  # rows looked at
FEWEST = 6


def frame_findings(model: Model, log: Log, metrology: Metrology) -> list[LogFinding]:
    """Return what is suspicious about where the measured poses are, or []."""
    measured = log.get("measured_position")
    q = log.get("actual_q") if log.has("actual_q") else log.get("target_q")
    if measured is None or q is None:
        return []
    good = np.flatnonzero(np.isfinite(measured).all(axis=1) & np.isfinite(q).all(axis=1))
    if len(good) < FEWEST:
        return []
    rows = good[np.unique(np.linspace(0, len(good) - 1, MOST).astype(int))]
    try:
        predicted = model.rigid_pose(q[rows]).position
    except InputError:
        return []
    positions = measured[rows]
    distance = _off(positions, predicted)
    findings = []
    if distance > MAX_ARM_ERROR:
        findings.append(_why(model, q, measured, rows, distance, log.get("measured_rotation")))
    elif metrology.registered:
        here = float(np.median(np.linalg.norm(positions - predicted, axis=1)))
        if here > MAX_ARM_ERROR and distance < MAX_SHARE_AFTER_CORRECTION * here:
            findings.append(LogFinding(LogCheck.NOT_IN_BASE, (here,)))
    turned = log.get("measured_rotation")
    if turned is not None and not findings:
        findings += _rotations(model, q[rows], positions, turned[rows], metrology)
    return findings


def _off(measured: Array, predicted: Array) -> float:
    """Return the median distance (m) in the frame that fits best."""
    frame = register_robustly(measured, predicted)
    return float(np.median(np.linalg.norm(frame.in_base(measured) - predicted, axis=1)))


def _why(
    model: Model, q: Array, measured: Array, rows: Array, distance: float, turned: Array | None
) -> LogFinding:
    """Return the finding on positions that do not follow the arm."""
    others = ((mistake, arm, q[rows], measured[rows]) for mistake, arm in other_arms(model))
    # another arm only where no mistake about this one says it
    for tried in (_mistakes(model, q, measured, rows, turned), others):
        best, named = distance, None
        for mistake, trial_model, trial_q, trial in tried:
            if len(trial) < FEWEST:
                continue
            left = _off(trial, trial_model.rigid_pose(trial_q).position)
            if left < MAX_RATIO_TO_BEST * best:
                best, named = left, mistake
        if named is not None and best < MAX_SHARE_AFTER_CORRECTION * distance:
            return LogFinding(LogCheck.POSITIONS_OFF_BY, (distance, named, best))
    return LogFinding(LogCheck.POSITIONS_OFF, (distance,))


def _mistakes(
    model: Model, q: Array, measured: Array, rows: Array, turned: Array | None
) -> Iterator[tuple[LogFinding, Model, Array, Array]]:
    """Yield each mistake with the model, joint angles and positions that would put it right."""
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
    rotation = None if turned is None else turned[rows]
    if rotation is None or not np.isfinite(rotation).all():
        rotation = rotation_vector(np.swapaxes(model.rigid_pose(q[rows]).rotation, 1, 2))
    yield LogFinding(LogCheck.INVERTED), model, q[rows], inverted(positions, rotation)


def _rotations(
    model: Model, q: Array, positions: Array, turned: Array, metrology: Metrology
) -> list[LogFinding]:
    good = np.isfinite(turned).all(axis=1)
    if good.sum() < FEWEST:
        return []
    q, positions, turned = q[good], positions[good], turned[good]
    poses = model.rigid_pose(q)
    frame = register_robustly(positions, poses.position)
    base = np.eye(3) if metrology.registered else frame.rotation
    left, constant = _turned_off(poses.rotation, base, rotation_matrix(turned))
    if left > 10 * MAX_ARM_ERROR:
        if _turned_off(poses.rotation, base, _roll_pitch_yaw(turned))[0] < MAX_ARM_ERROR:
            return [LogFinding(LogCheck.ROLL_PITCH_YAW)]
        return [LogFinding(LogCheck.ROTATIONS_OFF, (left,))]
    return [LogFinding(LogCheck.TARGET_AXES, (constant,))] if constant > 10 * MAX_ARM_ERROR else []


def _turned_off(predicted: Array, base: Array, measured: Array) -> tuple[float, float]:
    """Return how far (rad, median) rotations differ beside a constant turn, and that turn."""
    off = np.swapaxes(predicted, 1, 2) @ base.T @ measured
    U, _, Vt = np.linalg.svd(off.sum(axis=0))
    mean = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    left = np.linalg.norm(rotation_vector(mean.T @ off), axis=1)
    return float(np.median(left)), float(np.linalg.norm(rotation_vector(mean)))


def _roll_pitch_yaw(angles: Array) -> Array:
    x, y, z = (rotation_matrix(angles[:, k, None] * np.eye(3)[k]) for k in range(3))
    return np.asarray(z @ y @ x)
