"""The correction: the setpoint whose predicted real pose is the wanted one.

Newton's method in joint space on the exact prediction, with the Jacobian of the deflected arm,
damped near singularities (Levenberg; Nakamura, Hanafusa 1986), where the offset is limited to
LARGEST_OFFSET. For any number of joints; with more than six, the joint offset has minimum norm.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit

from gapbridge.core.arrays import Array, Index
from gapbridge.core.effects import CATALOGUE, settling
from gapbridge.core.errors import InputError
from gapbridge.core.kernels import reference as kernel
from gapbridge.core.kernels import single
from gapbridge.core.kernels.correction import correct_blocks
from gapbridge.core.kernels.least_offset import LARGEST_OFFSET as LARGEST_OFFSET
from gapbridge.core.kernels.least_offset import smallest_offset
from gapbridge.core.kernels.packed import (
    arm_block,
    chain_of,
    row_of,
    shape_of,
    shape_size,
    sizes_of,
    view_row,
    view_shape,
)
from gapbridge.core.kernels.reference import JIT, Chain
from gapbridge.core.kernels.single import LEVER, MAX_STEPS, SCRATCH, TOLERANCE
from gapbridge.core.kernels.threads import in_ranges
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model, Poses

NO_LOADS = Loads()
ROW_INDEX = np.int64  # type of a row number: a literal would be compiled as another signature
DEPENDENT = 1e-8  # share of a Jacobian's column beside the others below which it is rounding
SERVO_ROUNDS = 2  # fixed-point iterations of the inverse servo model


class Correction(NamedTuple):
    """Offset-corrected setpoints of N rows (or one: without the first axis).

    A tuple, because one is made in every cycle.
    """

    q: Array  # (N, n) rad
    offset_in_base: Array  # (N, 6) m, rad: rigid TCP pose at q minus that at nominal_q
    residual: Array | float  # (N,) m: distance of predicted and wanted pose (rotation x lever)
    steps: Index | int  # (N,) Newton steps taken


@njit(**JIT)
def _pose_error(shape, pose, error):  # type: ignore[no-untyped-def]
    """Write wanted minus predicted pose (6,), rotation part times the lever; returns its length."""
    for k in range(3):
        error[k] = pose[k] - shape.tcp_position[k]
        error[3 + k] = 0.0
    # for small angles the rotation vector of R_wanted R^T is half the sum of the axes' products
    R, rotation = shape.tcp_rotation, pose[3:].reshape((3, 3))
    for column in range(3):
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            error[3 + k] += (
                0.5 * LEVER * (R[a, column] * rotation[b, column]
                               - R[b, column] * rotation[a, column])
            )  # fmt: skip
    square = 0.0
    for k in range(6):
        square += error[k] * error[k]
    return np.sqrt(square)


@njit(**JIT)
def newton_offset(chain_block, row_block, shape_block, pose, offset):  # type: ignore[no-untyped-def]
    """Write the next joint offset (n,), given the one that the row's q holds; returns the distance.

    The distance (m) is that of the present shape from the wanted pose (12,); -1 where the arm has
    no equilibrium or a number is not finite. The whole offset is solved for, not an increment:
    null-space motion does not accumulate from setpoint to setpoint.
    """
    n = offset.shape[0]
    error, J = np.empty(6), np.empty((6, n))
    distance = _linearised(chain_block, row_block, shape_block, pose, error, J)
    if distance < 0:
        return -1.0
    for k in range(6):
        for i in range(n):
            error[k] += J[k, i] * offset[i]
    smallest_offset(J, error, offset)
    return distance


@njit(**JIT)
def _linearised(chain_block, row_block, shape_block, pose, error, J):  # type: ignore[no-untyped-def]
    """Write the pose error (6,) at the row's q and the Jacobian (6, n), rotations times the lever.

    Returns the distance (m) from the wanted pose (12,), -1 as ``newton_offset``.
    """
    n = J.shape[1]
    shape = shape_of(shape_block, n)
    if kernel.equilibrium(chain_of(chain_block, n), row_of(row_block, n), ROW_INDEX(0), shape) < 0:
        return -1.0
    distance = _pose_error(shape, pose, error)
    if not np.isfinite(distance):
        return -1.0
    kernel.jacobian(shape, J)
    for k in range(3, 6):
        for i in range(n):
            J[k, i] *= LEVER
    return distance


@njit(**JIT)
def _reachable(chain_block, row_block, shape_block, pose, J):  # type: ignore[no-untyped-def]
    """Return the part (m) of the distance from a wanted pose (12,) that lies within J's range.

    J (6, n) is overwritten by an orthonormal basis of it (Gram and Schmidt); inf where there is no
    equilibrium.
    """
    error, square = np.empty(6), 0.0
    if _linearised(chain_block, row_block, shape_block, pose, error, J) < 0:
        return np.inf
    for i in range(J.shape[1]):
        column = J[:, i]
        length = np.sqrt(np.sum(column * column))
        for _ in range(2):  # the second time for rounding
            for j in range(i):
                column -= np.sum(J[:, j] * column) * J[:, j]
        left = np.sqrt(np.sum(column * column))
        if left > DEPENDENT * length:
            column /= left
            part = np.sum(column * error)
            square += part * part
        else:
            column[:] = 0.0
    return np.sqrt(square)


@njit(**JIT)
def _rigid_pose(rigid_block, row_block, shape_block, q, pose):  # type: ignore[no-untyped-def]
    """Write the rigid TCP pose (12,) at q (n,), position (m) first."""
    n = q.shape[0]
    row, shape = row_of(row_block, n), shape_of(shape_block, n)
    for i in range(n):
        row.q[0, i] = q[i]
    A, B, base_rotation = np.empty((3, 3)), np.empty((3, 3)), np.zeros(3)
    kernel.place(chain_of(rigid_block, n), row, ROW_INDEX(0), shape, base_rotation, A, B)
    for i in range(3):
        pose[i] = shape.tcp_position[i]
        for j in range(3):
            pose[3 + 3 * i + j] = shape.tcp_rotation[i, j]


def block_of(chain: Chain, rigid: Chain) -> Array:
    """Return the working memory of the compiled correction, ``kernels.single.correct``."""
    workspace = np.zeros(chain.mass.shape[0] + SCRATCH)
    return np.concatenate([arm_block(chain), workspace, arm_block(rigid), np.zeros(24)])


def _views(block: Array, n: int) -> tuple[Array, Array, Array, Array]:
    """Return chain, row, shape, and the remainder of a block, as views of it."""
    c, r = sizes_of(n)
    s = c + r + shape_size(n)
    return block[:c], block[c : c + r], block[c + r : s], block[s:]


class Compensator:
    """Live compensation of one setpoint after the other, with buffers kept between them.

    ``correct`` costs a few microseconds. Not to be shared between threads.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self._n = n = model.arm.n
        chain = model.chain()
        self._block = block_of(chain, model.without_terms().chain())
        self._chain, self._row, self._shape, other = _views(self._block, n)
        self._offset = other[:n]
        other = other[n + SCRATCH :]
        self._rigid, self._rigid_row, self._rigid_shape, other = _views(other, n)
        self._wanted = other[:12]
        self._view = view_row(self._row, n)
        self._conditions = model.conditions()
        self._servo_terms = settling(model.terms)
        # one compiled call suffices: rigid links, and no effect depends on the joint angles
        self._unconditional = not (chain.flexibility.any() or self._conditions or self._servo_terms)
        self._pose = np.zeros(12)
        # loads where none are given
        self._mass, self._wrench = np.array([float(model.payload_mass)]), np.zeros((1, 6))
        self._cog = np.array(model.payload_cog, dtype=float).reshape(1, 3)

    def correct(self, nominal_q: Array, loads: Loads | None = None) -> Correction:
        """Return the corrected setpoint for ``nominal_q`` (n,); ``loads`` holds one row.

        The wanted pose is the rigid, effect-free arm's at ``nominal_q``. Servo effects in the model
        (droop, dead band) are compensated too. A row that cannot be solved is returned with the
        remaining distance in ``residual`` (inf: no equilibrium). Raises InputError for another
        number of joints: the compiled call would read beyond them.
        """
        n, loads = self._n, loads or NO_LOADS
        result, nominal = np.empty(n + 6), np.ascontiguousarray(nominal_q, dtype=float)
        if nominal.shape != (n,):
            raise InputError(f"nominal_q: found an array {nominal.shape}, expected ({n},)")
        q, moved = result[:n], result[n:]
        if self._unconditional:
            mass, cog, wrench = loads.payload_mass, loads.payload_cog, loads.wrench
            best, steps = single.correct(
                self._block, nominal, self._mass if mass is None else mass,
                self._cog if cog is None else cog, self._wrench if wrench is None else wrench,
                result,
            )  # fmt: skip
        else:
            rigid = self._rigid
            _rigid_pose(rigid, self._rigid_row, self._rigid_shape, nominal, self._wanted)
            best, steps = self._solve_rows(nominal, loads, q)
            self._offset[:] = q - nominal if best < np.inf else 0.0
            if best < np.inf:  # what is not solved is no setpoint, and may be no number
                self._invert_servos(loads, q)
            _rigid_pose(rigid, self._rigid_row, self._rigid_shape, q, self._pose)
            single.motion(self._wanted, self._pose, bool((q != nominal).any()), moved)
        return Correction(q, moved, best, steps)

    def missed(self, nominal_q: Array, loads: Loads, residual: float) -> float:
        """Return the part (m) of the last correction's residual that the joints could correct.

        With fewer than six joints the rest is out of their reach; from six on it is all of it.
        """
        n = self._n
        if n >= 6 or not residual < np.inf:
            return residual
        row, trial = self._view, nominal_q + self._offset
        self._write_loads(loads)
        row.q[0], row.link_scale[0] = trial, 1.0
        self.model.condition(row, loads, trial[None], self._conditions)
        # a shape of its own: the one of the compiled call is laid out in another way
        J, shape = np.empty((6, n)), np.zeros(len(self._shape))
        return float(_reachable(self._chain, self._row, shape, self._wanted, J))

    def correct_rows(self, nominal_q: Array, loads: Loads) -> Correction:
        """Return the corrected setpoints for ``nominal_q`` (N, n), as ``correct`` does."""
        n, count = self._n, len(nominal_q)
        nominal = np.ascontiguousarray(nominal_q, dtype=float)
        result, residual = np.empty((count, n + 6)), np.empty(count)
        steps = np.empty(count, dtype=np.int64)
        if self._unconditional:
            self._correct_blocks(nominal, loads, (result, residual, steps))
        else:
            for r in range(count):
                one = self.correct(nominal[r], loads[r : r + 1])
                result[r, :n], result[r, n:] = one.q, one.offset_in_base
                residual[r], steps[r] = one.residual, one.steps
        return Correction(result[:, :n], result[:, n:], residual, steps)

    def _correct_blocks(
        self, nominal: Array, loads: Loads, out: tuple[Array, Array, Index]
    ) -> None:
        """Write the corrections of rows without effects that depend on the joint angles.

        In blocks; rows near singularities, which the blocks do not solve, one after the other.
        """
        rows, chain = self.model.rows(nominal, loads), self.model.chain()
        rigid = self.model.without_terms().chain()

        def work(first: int, last: int) -> None:
            correct_blocks(chain, rigid, rows, first, last, out)

        in_ranges(work, len(nominal))
        unsolved = np.flatnonzero(out[2] == 0)
        if len(unsolved):
            some = tuple(part[unsolved] for part in out)
            columns = [part[unsolved] for part in (rows.q, *rows[2:])]
            single.correct_rows(self._block, *columns, some)
            for part, values in zip(out, some, strict=True):
                part[unsolved] = values

    def reset(self) -> None:
        """Start the next correction from zero, not from the last solution."""
        self._offset[:] = 0.0
        self._shape[:] = 0.0

    def _solve_rows(self, nominal: Array, loads: Loads, q: Array) -> tuple[float, int]:
        """Solve one row with flexible links, or with effects evaluated in each step."""
        best, steps, row, offset = np.inf, 0, self._view, self._offset
        q[:] = nominal
        for steps in range(1, MAX_STEPS + 1):  # noqa: B007
            trial = nominal + offset
            self._write_loads(loads)
            row.q[0], row.link_scale[0] = trial, 1.0
            self.model.condition(row, loads, trial[None], self._conditions)
            distance = newton_offset(self._chain, self._row, self._shape, self._wanted, offset)
            if distance < 0:
                break
            if distance < best:
                q[:], best = trial, distance
            if distance < TOLERANCE:
                break
        return best, steps

    def _invert_servos(self, loads: Loads, q: Array) -> None:
        """Change encoder angles ``q`` (n,), rad, into the commands for which servos rest there."""
        if not self._servo_terms:
            return
        shape = view_shape(self._shape, self._n)
        torque = -np.sum(shape.axis * shape.moment, axis=1)[None]
        wanted, command = q.copy(), q[None].copy()
        for _ in range(SERVO_ROUNDS):
            resting = command
            for term in self._servo_terms:
                effect = CATALOGUE[term.effect]
                resting = effect.settle(term, self.model.arm, resting, torque, loads.approach)
            command = command + (wanted - resting)
        q[:] = command[0]

    def _write_loads(self, loads: Loads) -> None:
        """Write the loads into the row's buffers."""
        row, mass, cog, wrench = self._view, loads.payload_mass, loads.payload_cog, loads.wrench
        row.payload_mass[0] = (self._mass if mass is None else mass)[0]
        row.payload_cog[0] = (self._cog if cog is None else cog)[0]
        row.wrench[0] = (self._wrench if wrench is None else wrench)[0]


def correct(model: Model, nominal_q: Array, loads: Loads | None = None) -> Correction:
    """Return the corrected setpoints of many rows (N, n), as ``Compensator.correct`` does."""
    q = np.atleast_2d(np.asarray(nominal_q, dtype=float))
    # without times: slips have happened before any setpoint
    return Compensator(model).correct_rows(q, replace(loads or Loads(), time=None))


def wanted_pose(model: Model, nominal_q: Array) -> Poses:
    """Return the wanted poses of setpoints ``nominal_q`` (N, n): the rigid, effect-free arm's."""
    return model.rigid_pose(np.atleast_2d(nominal_q))
