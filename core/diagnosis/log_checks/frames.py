"""Log checks for mistakes of frames, axes, signs and rows, by the measured poses.

Errors of an arm are millimetres. If poses are off by centimetres, a frame, an axis, a sign or a row
is wrong; the correction that makes measured and predicted poses agree identifies the mistake. The
usual ones of a kinematic model are tried one by one: joint order, modified DH rows, signs and units
of lengths, TCP.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from gapbridge.core.arm import Arm, builtin_arm, builtin_names, dh_transform
from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.criteria import (
    MAX_ARM_ERROR,
    MAX_RATIO_TO_BEST,
    MAX_SHARE_AFTER_CORRECTION,
)
from gapbridge.core.diagnosis.log_checks.signs import checked_rows, spread_of
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.least_squares import solve
from gapbridge.core.estimation.registration import register, register_robustly
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix, rotation_vector

MIN_ROWS = 6
MAX_PERMUTED = 6  # joints up to which all orders are tried: 720
ORDER_ROWS = 24  # rows on which orders are compared
DH_TOLERANCE = 1e-6  # m, rad: of frames that are standard DH rows
MIN_POINT_ROWS = 12  # for nine unknowns, point and frame
STEPS = 10  # of Gauss-Newton
OUTLIER_DISTANCE = 5.0  # times the median distance, from which a row is an outlier
MAX_TOOL_LENGTH = 2.0  # m from the flange


def frame_findings(model: Model, log: Log, metrology: Metrology) -> list[LogFinding]:
    """Return the findings on the frames of the measured poses."""
    measured = log.get("measured_position")
    q = log.get("actual_q", "target_q")
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


def other_models(model: Model) -> Iterator[tuple[LogFinding, Model]]:
    """Yield each possible mistake in the model, with the corrected model."""
    without_tool = np.eye(4)
    if np.linalg.norm(model.tool_in_flange[:3, 3]) > 0:
        without_tool[:3, :3] = model.tool_in_flange[:3, :3]
        yield LogFinding(LogCheck.FLANGE_NOT_TCP), replace(model, tool_in_flange=without_tool)
        turned = model.tool_in_flange.copy()
        turned[:3, 3] *= -1
        yield LogFinding(LogCheck.TCP_SIGN), replace(model, tool_in_flange=turned)
    rows = None if model.arm.joint_names else dh_rows(model.arm)
    if rows is None:
        return
    yield LogFinding(LogCheck.MODIFIED_DH), replace(model, arm=_modified(model.arm, rows))
    for key, column in (("a", 0), ("alpha", 1), ("d", 2), ("offset", 3)):
        if not np.any(rows[:, column]):
            continue
        changed = rows.copy()
        changed[:, column] *= -1
        sign = LogFinding(LogCheck.DH_SIGN, (key,))
        yield sign, replace(model, arm=_standard(model.arm, changed))
    for unit, size in (("inches", 0.0254), ("centimetres", 0.01)):
        changed = rows * [size, 1.0, size, 1.0]
        lengths = LogFinding(LogCheck.DH_UNIT, (unit,))
        yield lengths, replace(model, arm=_standard(model.arm, changed))


def other_arms(model: Model) -> Iterator[tuple[LogFinding, Model]]:
    """Yield the model with each other built-in arm of the same number of joints."""
    for name in builtin_names():
        arm = builtin_arm(name)
        if name != model.arm.name and arm.n == model.arm.n:
            yield LogFinding(LogCheck.OTHER_ARM, (name,)), replace(model, arm=arm)


def measured_point(model: Model, q: Array, measured: Array) -> tuple[LogFinding, Model] | None:
    """Return the point on the flange of the measured positions (N, 3), and the model with it.

    The point and the instrument's frame are fitted together (Gauss-Newton, twice: the second time
    without outliers). None if there are too few rows.
    """
    if len(q) < MIN_POINT_ROWS:
        return None
    without_tool = replace(model, tool_in_flange=np.eye(4))
    flange = without_tool.rigid_pose(q)
    kept, point = np.ones(len(q), bool), np.zeros(3)
    for _ in range(2):
        position, rotation = flange.position[kept], flange.rotation[kept]
        point, distance = _point_on_flange(position, rotation, measured[kept])
        if np.linalg.norm(point) > MAX_TOOL_LENGTH:
            return None
        kept[kept] = distance <= OUTLIER_DISTANCE * np.median(distance)
        if kept.sum() < MIN_POINT_ROWS:
            return None
    tool = model.tool_in_flange.copy()
    declared = tool[:3, 3].copy()
    tool[:3, 3] = point
    points = tuple(map(float, point)), tuple(map(float, declared))
    other = LogFinding(LogCheck.OTHER_TCP, points)
    finding = other if np.any(declared) else LogFinding(LogCheck.NO_TCP, points[:1])
    return finding, replace(model, tool_in_flange=tool)


def _point_on_flange(position: Array, rotation: Array, measured: Array) -> tuple[Array, Array]:
    """Return the point (3,) in the flange, m, and each row's residual distance (N,), m."""
    point = np.zeros(3)
    for _ in range(STEPS):
        predicted_point = position + rotation @ point
        in_base = register(measured, predicted_point).in_base(measured)
        deviation = (in_base - predicted_point).ravel()
        turn = np.zeros((len(in_base), 3, 3))  # columns: a small turn of the instrument's frame
        for k, axis in enumerate(np.eye(3)):
            turn[:, :, k] = np.cross(axis, in_base)
        shift = np.broadcast_to(np.eye(3), turn.shape)
        columns = np.concatenate([rotation, -turn, -shift], axis=2).reshape(-1, 9)
        point = point + solve(columns, deviation, rank=1e-6)[:3]
    predicted_point = position + rotation @ point
    distance = np.linalg.norm(
        register(measured, predicted_point).in_base(measured) - predicted_point, axis=1
    )
    return point, np.asarray(distance)


def best_order(model: Model, q: Array, measured: Array) -> tuple[LogFinding, Array] | None:
    """Return the order of joints that fits positions (N, 3) best, and q in it.

    All orders of up to six joints; of more, exchanges of two and cyclic shifts. None if the given
    order is the best.
    """
    n = q.shape[1]
    rows = np.unique(np.linspace(0, len(q) - 1, ORDER_ROWS).astype(int))
    few, target = q[rows], measured[rows]
    orders = list(_orders(n))
    stacked = model.rigid_pose(np.concatenate([few[:, order] for order in orders])).position
    best, chosen = np.inf, orders[0]
    for order, predicted in zip(orders, np.split(stacked, len(orders)), strict=True):
        deviation = register(target, predicted).in_base(target) - predicted
        error = float(np.median(np.linalg.norm(deviation, axis=1)))
        if error < best - 1e-12:
            best, chosen = error, order
    if chosen == tuple(range(n)):
        return None
    return _order(chosen), q[:, chosen]


def _orders(n: int) -> Iterator[tuple[int, ...]]:
    given_order = tuple(range(n))
    yield given_order
    if n <= MAX_PERMUTED:
        if n > 2:
            yield _exchanged(given_order, 0, 2)  # ROS sorts a UR's joints by name: elbow first
        yield from (order for order in itertools.permutations(given_order) if order != given_order)
        return
    yield from (_exchanged(given_order, i, j) for i, j in itertools.combinations(given_order, 2))
    yield from (given_order[k:] + given_order[:k] for k in range(1, n))
    yield given_order[::-1]


def _exchanged(order: tuple[int, ...], i: int, j: int) -> tuple[int, ...]:
    swapped = list(order)
    swapped[i], swapped[j] = swapped[j], swapped[i]
    return tuple(swapped)


def _order(order: tuple[int, ...]) -> LogFinding:
    """Return the finding on a joint order: ``order[i]`` is the column of joint i + 1."""
    n = len(order)
    moved = [i for i in range(n) if order[i] != i]
    if order == tuple(range(n))[::-1]:
        return LogFinding(LogCheck.JOINTS_REVERSED)
    if len(moved) == 2:
        i, j = moved
        by_name = (i, j, n) == (0, 2, 6)
        check = LogCheck.UR_JOINTS_SWAPPED if by_name else LogCheck.JOINTS_SWAPPED
        return LogFinding(check, (i + 1, j + 1))
    return LogFinding(LogCheck.JOINT_ORDER, (tuple((i + 1, order[i]) for i in moved),))


def inverted(measured: Array, turned: Array) -> Array:
    """Return positions (N, 3) of the inverse poses, which were measured in the tool frame."""
    return np.asarray(-np.einsum("nji,nj->ni", rotation_matrix(turned), measured))


def dh_rows(arm: Arm) -> Array | None:
    """Return standard DH rows (n, 4) a, alpha, d, offset of an arm; None if it has none."""
    rows = np.zeros((arm.n, 4))
    before = arm.link_in_link[0]
    if np.abs(before[:3, 3]).max() > DH_TOLERANCE or abs(before[2, 2] - 1) > DH_TOLERANCE:
        return None
    rows[0, 3] = np.arctan2(before[1, 0], before[0, 0])
    for i in range(arm.n):
        link = arm.link_in_link[i + 1]
        # Tz(d) Tx(a) Rx(alpha) and the next row's Rz(offset)
        alpha = np.arctan2(-link[1, 2], link[2, 2])
        offset = np.arctan2(-link[0, 1], link[0, 0])
        rows[i, :3] = link[0, 3], alpha, link[2, 3]
        if i + 1 < arm.n:
            rows[i + 1, 3] = offset
        if np.abs(link - _link(link[0, 3], alpha, link[2, 3], offset)).max() > DH_TOLERANCE:
            return None
    return rows


def _link(a: float, alpha: float, d: float, offset: float) -> Array:
    """Return a DH row's transform (4, 4) with the next row's Rz(offset)."""
    c, s, turn = np.cos(offset), np.sin(offset), np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    return dh_transform(a, alpha, d) @ turn


def _standard(arm: Arm, rows: Array) -> Arm:
    links = [_link(0.0, 0.0, 0.0, rows[0, 3])]
    offsets = [*rows[1:, 3], 0.0]
    links += [
        _link(a, alpha, d, offset) for (a, alpha, d, _), offset in zip(rows, offsets, strict=True)
    ]
    return replace(arm, link_in_link=np.array(links))


def _modified(arm: Arm, rows: Array) -> Arm:
    """Return the arm whose rows are Craig's: Rx(alpha) Tx(a) Rz(q + offset) Tz(d)."""
    before = [0.0, *rows[:, 2]]  # d of the row before
    links = [_link(row[0], row[1], d, row[3]) for row, d in zip(rows, before, strict=False)]
    return replace(arm, link_in_link=np.array([*links, _link(0.0, 0.0, before[-1], 0.0)]))
