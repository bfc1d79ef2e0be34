"""The correction: the setpoint whose predicted real pose is the wanted one.

Solved in joint space by Newton's method on the exact prediction with the Jacobian of the bent arm,
damped near singularities (Levenberg; Nakamura, Hanafusa 1986), where the offset stays within
LARGEST_OFFSET. Works for fewer, six and more joints; with more, the joint offset is the smallest
one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core import kernel
from core.kernel import JIT, Chain, Rows, Shape
from core.loads import Loads
from core.model import Model, Poses
from core.rotation import rotation_vector

Array = NDArray[np.float64]
TOLERANCE = 1e-9  # m, and rad times the tool's lever: where the pose counts as reached
MAX_STEPS = 12
LEVER = 0.5  # m: weighs a rotation against a shift
LARGEST_OFFSET = 0.1  # rad: joint offset (norm) beyond which the correction is damped


@dataclass(frozen=True)
class Correction:
    """Offset-corrected setpoints of N rows (or one: without the first axis)."""

    q: Array  # (N, n) rad
    offset_in_base: Array  # (N, 6) m, rad: rigid TCP pose at q minus that at nominal_q
    residual: Array  # (N,) m: distance of the predicted pose from the wanted one (rotation x lever)
    steps: NDArray[np.int64]  # (N,) Newton steps taken


@njit(**JIT)
def _smallest_offset(J, wanted, offset):  # type: ignore[no-untyped-def]
    """Write the least-squares solution of J offset = wanted, damped to LARGEST_OFFSET.

    Rows of J and wanted are weighted by the lever already. Of many solutions (more than six
    joints, singular poses) the shortest one. Undamped wherever that is short enough, so that the
    wanted pose is met exactly right up to a singularity.
    """
    n = J.shape[1]
    wide = n > 6
    # the smaller, regular one of J J^T and J^T J; s holds the squared singular values
    G = J @ J.T if wide else J.T @ J
    s, V = np.linalg.eigh(G)
    y = V.T @ wanted if wide else V.T @ (J.T @ wanted)
    damping = 1e-14 * max(s[-1], 1e-12)
    for _ in range(60):
        square = 0.0
        for i in range(s.shape[0]):
            part = y[i] / (max(s[i], 0.0) + damping)
            square += part * part * (max(s[i], 0.0) if wide else 1.0)
        if square <= LARGEST_OFFSET * LARGEST_OFFSET:
            break
        damping *= 3.0
    for i in range(s.shape[0]):
        y[i] /= max(s[i], 0.0) + damping
    solution = V @ y
    offset[:] = J.T @ solution if wide else solution


@njit(**JIT)
def _pose_error(shape, position, rotation, lever, error):  # type: ignore[no-untyped-def]
    """Write wanted minus predicted pose (6,), rotation part times the lever; returns its length."""
    for k in range(3):
        error[k] = position[k] - shape.tcp_position[k]
        error[3 + k] = 0.0
    # for small angles the rotation vector of R_wanted R^T is half the sum of the axes' products
    R = shape.tcp_rotation
    for column in range(3):
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            error[3 + k] += (
                0.5 * lever * (R[a, column] * rotation[b, column]
                               - R[b, column] * rotation[a, column])
            )  # fmt: skip
    square = 0.0
    for k in range(6):
        square += error[k] * error[k]
    return np.sqrt(square)


@njit(**JIT)
def next_offset(chain, rows, r, shape, position, rotation, lever, offset):  # type: ignore[no-untyped-def]
    """Write the next joint offset of row r, given the one that its q holds; returns the distance.

    The distance (m) is that of the present shape from the wanted pose; -1 where the arm has no
    equilibrium or a number is not finite. The whole offset is solved for anew, not a step on top:
    what turns joints without moving the tool cannot pile up from setpoint to setpoint.
    """
    n = chain.mass.shape[0]
    if kernel.equilibrium(chain, rows, r, shape) < 0:
        return -1.0
    error, J = np.empty(6), np.empty((6, n))
    distance = _pose_error(shape, position, rotation, lever, error)
    if not np.isfinite(distance):
        return -1.0
    kernel.jacobian(shape, J)
    J[3:] *= lever
    _smallest_offset(J, error + J @ offset, offset)
    return distance


@njit(**JIT)
def newton_step(chain, rows, r, shape, position, rotation, lever, dq):  # type: ignore[no-untyped-def]
    """Write the joint step of row r towards the wanted pose; returns the present distance.

    ``next_offset`` for joints that hold no offset yet.
    """
    dq[:] = 0.0
    return next_offset(chain, rows, r, shape, position, rotation, lever, dq)


class Compensator:
    """Live compensation of one setpoint after the other, with buffers kept between them.

    ``correct`` costs a few tens of microseconds. Not to be shared between threads.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self._chain: Chain = model.chain()
        self._rigid: Chain = model.without_terms().chain()
        self._shape: Shape = kernel.new_shape(model.arm.n)
        self._rigid_shape: Shape = kernel.new_shape(model.arm.n)
        self._offset = np.zeros(model.arm.n)

    def correct(self, nominal_q: Array, loads: Loads | None = None) -> Correction:
        """Return the corrected setpoint for ``nominal_q`` (n,); ``loads`` holds one row.

        The wanted pose is the rigid, effect-free arm's at ``nominal_q``. A row that cannot be
        solved comes back with the distance left in ``residual`` (inf: no equilibrium).
        """
        row = np.array(nominal_q, dtype=float, order="C")[None]
        position, rotation = self._rigid_pose(self._plain(row))
        shape, offset = self._shape, self._offset.copy()
        best_q, best, steps = row, np.inf, 0
        for steps in range(1, MAX_STEPS + 1):  # noqa: B007
            q = row + offset
            rows = self.model.rows(q, loads)
            distance = _next_offset(self._chain, rows, shape, position, rotation, offset)
            if distance < 0:
                break
            if distance < best:
                best_q, best = q, distance
            if distance < TOLERANCE:
                break
        self._offset = (best_q - row)[0] if best < np.inf else np.zeros(row.shape[1])
        pose = self._rigid_pose(self._plain(best_q))
        moved = np.concatenate([pose[0] - position, rotation_vector(pose[1] @ rotation.T)])
        return Correction(best_q[0], moved, np.asarray(best), np.asarray(steps))

    def _plain(self, q: Array) -> Rows:
        n = q.shape[1]
        return Rows(q, np.ones((1, n)), np.zeros(1), np.zeros((1, 3)), np.zeros((1, 6)))

    def _rigid_pose(self, rows: Rows) -> tuple[Array, Array]:
        shape = self._rigid_shape
        shape.bend[:] = 0.0  # nothing bends; and no row may spoil the next
        kernel.equilibrium(self._rigid, rows, 0, shape)
        return shape.tcp_position.copy(), shape.tcp_rotation.copy()


def _next_offset(
    chain: Chain, rows: Rows, shape: Shape, position: Array, rotation: Array, offset: Array
) -> float:
    """Return the distance of row 0 from the wanted pose and write the next joint offset."""
    return float(next_offset(chain, rows, 0, shape, position, rotation, LEVER, offset))


def correct(model: Model, nominal_q: Array, loads: Loads | None = None) -> Correction:
    """Return the corrected setpoints of many rows (N, n): ``Compensator.correct`` row by row."""
    q = np.atleast_2d(np.asarray(nominal_q, dtype=float))
    loads, live = loads or Loads(), Compensator(model)
    results = [live.correct(q[r], loads[r : r + 1]) for r in range(len(q))]
    return Correction(
        np.array([c.q for c in results]).reshape(q.shape),
        np.array([c.offset_in_base for c in results]).reshape(len(q), 6),
        np.array([c.residual for c in results]),
        np.array([c.steps for c in results]),
    )


def wanted_pose(model: Model, nominal_q: Array) -> Poses:
    """Return the poses that setpoints ``nominal_q`` (N, n) mean: the rigid, effect-free arm's."""
    return model.rigid_pose(np.atleast_2d(nominal_q))
