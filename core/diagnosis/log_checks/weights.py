"""Log checks by the links' weights, most of what motors hold: mounting and unit of the torques.

Weights are linear in gravity. If another direction of about the same strength explains the torques
much better, each joint's friction and a constant aside, the arm hangs on a wall or a ceiling, and
the cell does not say so. If the torques are a small share of the weights at every joint that bears
some, they are currents.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.criteria import MAX_SHARE_WITH_OTHER_SIGN
from gapbridge.core.diagnosis.log_checks.signs import checked_rows, loads_with
from gapbridge.core.dynamics import predict_torque
from gapbridge.core.estimation.least_squares import solve
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion

MIN_ROWS = 30
MIN_ANGLE = 0.35  # rad from the cell's gravity: no base is levelled worse
STRENGTH = 0.7, 1.4  # times the cell's gravity: the links' masses are not exact
MIN_TORQUE = 1.0  # Nm, rms of the weights' torque at the joint that bears most
OPPOSITE = 2.6  # rad from the cell's gravity, from where torques of the wrong sign look alike
MIN_SIGMAS = 3.0  # of the friction's sum, to tell a ceiling from torques of the wrong sign
BEARING = 5.0  # Nm, rms of the weights' torque at a joint, from which its share is known
MIN_BEARING = 2  # joints
CURRENTS = 0.02, 0.3  # A/Nm: 0.07 to 0.1 of UR arms; torques with any friction exceed 0.5


def weight_findings(model: Model, log: Log) -> list[LogFinding]:
    """Return the finding on a gravity, or a unit, that the motor torques contradict."""
    torque, q = log.get("actual_current_as_torque"), log.get("actual_q")
    if torque is None or q is None or log.has("actual_TCP_force") or not model.arm.mass.any():
        return []
    speed = log.get("actual_qd")
    speed = np.gradient(q, axis=0) if speed is None and len(q) > 1 else speed
    rows = checked_rows(q, torque, speed)
    if speed is None or len(rows) < MIN_ROWS:
        return []
    if (torque[rows] == torque[rows[0]]).all():  # the controller gives none
        return []
    weights = _weights(model, log, q, rows)
    if np.sqrt(np.mean((weights @ model.gravity) ** 2, axis=0)).max() < MIN_TORQUE:
        return []
    way = np.sign(speed[rows])
    if currents := _currents(weights @ model.gravity, torque[rows], way):
        return [currents]
    gravity, before, after, friction = _fitted(model, weights, torque[rows], way)
    strength = np.linalg.norm(gravity) / np.linalg.norm(model.gravity)
    angle = _angle(gravity, model.gravity)
    if (
        after > MAX_SHARE_WITH_OTHER_SIGN * before
        or not STRENGTH[0] < strength < STRENGTH[1]
        or angle < MIN_ANGLE
        or (angle > OPPOSITE and friction < MIN_SIGMAS)
    ):
        return []
    return [
        LogFinding(LogCheck.GRAVITY, tuple(tuple(map(float, g)) for g in (gravity, model.gravity)))
    ]


def _weights(model: Model, log: Log, q: Array, rows: Index) -> Array:
    """Return the static torques (N, n, 3) Nm per m/s² of gravity along each axis of the base."""
    at_rest = Motion.at_rest(q[rows], loads_with(log, rows, None))
    along = [predict_torque(replace(model, terms=(), gravity=axis), at_rest) for axis in np.eye(3)]
    return np.stack(along, axis=2)


def _currents(weight: Array, torque: Array, way: Array) -> LogFinding | None:
    """Return the finding on torques (N, n) that are a small share of the weights' (N, n)."""
    bearing = np.flatnonzero(np.sqrt(np.mean(weight**2, axis=0)) > BEARING)
    shares = []
    for j in bearing:
        A = np.column_stack([weight[:, j], way[:, j]])
        x = solve(A, torque[:, j])
        left = float(np.sqrt(np.mean((torque[:, j] - A @ x) ** 2)))
        if left > MAX_SHARE_WITH_OTHER_SIGN * float(np.sqrt(np.mean(torque[:, j] ** 2))):
            return None
        shares.append(float(x[0]))
    if len(shares) < MIN_BEARING or not all(CURRENTS[0] < x < CURRENTS[1] for x in shares):
        return None
    return LogFinding(
        LogCheck.CURRENTS, (float(np.median(shares)), tuple(int(j) + 1 for j in bearing))
    )


def _fitted(
    model: Model, weights: Array, torque: Array, way: Array
) -> tuple[Array, float, float, float]:
    """Return the gravity (3,) that fits, the rms with the cell's and with it, and the friction.

    Rms of the joints' torques over their own scatter; the friction is the sum of all joints'
    coefficients over its standard deviation.
    """
    count, n = torque.shape
    scale = np.maximum(torque.std(axis=0), 1e-9)
    own = np.zeros((count, n, 2 * n))
    for j in range(n):
        own[:, j, j], own[:, j, n + j] = way[:, j], 1.0
    own = (own / scale[:, None]).reshape(count * n, 2 * n)
    columns = (weights / scale[:, None]).reshape(count * n, 3)
    measured = (torque / scale).ravel()
    nominal = measured - columns @ model.gravity
    before = nominal - own @ solve(own, nominal)
    A = np.hstack([columns, own])
    x = solve(A, measured)
    after = measured - A @ x
    variance = float(after @ after) / max(len(after) - A.shape[1], 1) * np.linalg.pinv(A.T @ A)
    friction = slice(3, 3 + n)
    spread = np.sqrt(max(float(variance[friction, friction].sum()), 1e-300))
    return (
        x[:3], float(np.sqrt(np.mean(before**2))), float(np.sqrt(np.mean(after**2))),
        float(x[friction].sum()) / spread,
    )  # fmt: skip


def _angle(a: Array, b: Array) -> float:
    return float(np.arccos(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), -1.0, 1.0)))
