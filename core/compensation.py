"""The correction: the setpoint whose predicted real pose is the wanted one.

Solved in joint space by Newton's method on the exact prediction with the Jacobian of the bent arm,
damped near singularities (Levenberg; Nakamura, Hanafusa 1986). Works for fewer, six and more joints; with
more, the joint offset is the smallest one.
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
LARGEST_STEP = 0.05  # rad: joint step (norm) beyond which a Newton step is damped


@dataclass(frozen=True)
class Correction:
    """Offset-corrected setpoints of N rows (or one: without the first axis)."""

    q: Array  # (N, n) rad
    offset_in_base: Array  # (N, 6) m, rad: rigid TCP pose at q minus that at nominal_q
    residual: Array  # (N,) m: distance of the predicted pose from the wanted one (rotation x lever)
    steps: NDArray[np.int64]  # (N,) Newton steps taken


@njit(**JIT)
def _damped_step(J, error, dq):  # type: ignore[no-untyped-def]
    """Write the least-squares step J+ error, damped just enough to stay within LARGEST_STEP.

    Rows of J and error are weighted by the lever already. Undamped wherever the plain step is
    short, so that the wanted pose is met exactly right up to a singularity.
    """
    n = J.shape[1]
    wide = n > 6
    # the smaller, regular one of J J^T and J^T J; s holds the squared singular values
    G = J @ J.T if wide else J.T @ J
    s, V = np.linalg.eigh(G)
    y = V.T @ error if wide else V.T @ (J.T @ error)
    damping = 1e-14 * max(s[-1], 1e-12)
    for _ in range(60):
        square = 0.0
        for i in range(s.shape[0]):
            part = y[i] / (max(s[i], 0.0) + damping)
            square += part * part * (max(s[i], 0.0) if wide else 1.0)
        if square <= LARGEST_STEP * LARGEST_STEP:
            break
        damping *= 3.0
    for i in range(s.shape[0]):
        y[i] /= max(s[i], 0.0) + damping
    step = V @ y
    dq[:] = J.T @ step if wide else step


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
def newton_step(chain, rows, r, shape, position, rotation, lever, dq):  # type: ignore[no-untyped-def]
    """Write the joint step of row r towards the wanted pose; returns the present distance (m).

    Returns -1 where the arm has no equilibrium.
    """
    n = chain.mass.shape[0]
    if kernel.equilibrium(chain, rows, r, shape) < 0:
        return -1.0
    error, J = np.empty(6), np.empty((6, n))
    distance = _pose_error(shape, position, rotation, lever, error)
    kernel.jacobian(shape, J)
    J[3:] *= lever
    _damped_step(J, error, dq)
    return distance


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
        rigid_rows = self._plain(row)
        position, rotation = self._rigid_pose(rigid_rows)
        shape, dq = self._shape, np.empty(row.shape[1])
        q, steps, distance = row + self._offset, 0, np.inf
        best_q, best = q, np.inf
        for steps in range(1, MAX_STEPS + 1):  # noqa: B007
            rows = self.model.rows(q, loads)
            distance = kernel_step(self._chain, rows, shape, position, rotation, dq)
            if distance < 0:
                shape.bend[:] = 0.0
                shape.tip[:] = 0.0
                break
            if distance < best:
                best_q, best = q, distance
            if distance < TOLERANCE:
                break
            q = q + dq
        self._offset = (best_q - row)[0] if best < 1e-3 else np.zeros(row.shape[1])
        pose = self._rigid_pose(self._plain(best_q))
        offset = np.concatenate(
            [pose[0] - position, rotation_vector(pose[1] @ rotation.T)]
        )
        return Correction(best_q[0], offset, np.float64(best), np.int64(steps))

    def _plain(self, q: Array) -> Rows:
        n = q.shape[1]
        return Rows(q, np.ones((1, n)), np.zeros(1), np.zeros((1, 3)), np.zeros((1, 6)))

    def _rigid_pose(self, rows: Rows) -> tuple[Array, Array]:
        shape = self._rigid_shape
        kernel.equilibrium(self._rigid, rows, 0, shape)
        return shape.tcp_position.copy(), shape.tcp_rotation.copy()


def kernel_step(
    chain: Chain, rows: Rows, shape: Shape, position: Array, rotation: Array, dq: Array
) -> float:
    """Return the distance of row 0 from the wanted pose and write the joint step towards it."""
    return float(newton_step(chain, rows, 0, shape, position, rotation, LEVER, dq))


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
