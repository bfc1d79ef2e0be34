"""The correction: the setpoint whose predicted real pose is the wanted one.

Solved in joint space by Newton's method on the exact prediction with the Jacobian of the bent arm,
damped near singularities (Levenberg; Nakamura, Hanafusa 1986), where the offset stays within
LARGEST_OFFSET. Works for fewer, six and more joints; with more, the joint offset is the smallest
one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit

from gapbridge.core.arrays import Array, Index
from gapbridge.core.effects import CATALOGUE, settling
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

NOTHING = Loads()
ROW = np.int64  # of a number of a row: a literal would compile anew all that is called with it
LEADS = 2  # times that a servo's rest is looked at for the command that leads there


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
def next_offset(chain_block, row_block, shape_block, pose, offset):  # type: ignore[no-untyped-def]
    """Write the next joint offset (n,), given the one that the row's q holds; returns the distance.

    The distance (m) is that of the present shape from the wanted pose (12,); -1 where the arm has
    no equilibrium or a number is not finite. The whole offset is solved for anew, not a step on
    top: what turns joints without moving the tool cannot pile up from setpoint to setpoint.
    """
    n = offset.shape[0]
    shape = shape_of(shape_block, n)
    if kernel.equilibrium(chain_of(chain_block, n), row_of(row_block, n), ROW(0), shape) < 0:
        return -1.0
    error, J = np.empty(6), np.empty((6, n))
    distance = _pose_error(shape, pose, error)
    if not np.isfinite(distance):
        return -1.0
    kernel.jacobian(shape, J)
    for k in range(6):
        for i in range(n):
            if k > 2:
                J[k, i] *= LEVER
            error[k] += J[k, i] * offset[i]
    smallest_offset(J, error, offset)
    return distance


@njit(**JIT)
def _rigid_pose(rigid_block, row_block, shape_block, q, pose):  # type: ignore[no-untyped-def]
    """Write the rigid TCP pose (12,) at q (n,), position first; nothing of the shape bends."""
    n = q.shape[0]
    row, shape = row_of(row_block, n), shape_of(shape_block, n)
    for i in range(n):
        row.q[0, i] = q[i]
    A, B, base_rotation = np.empty((3, 3)), np.empty((3, 3)), np.zeros(3)
    kernel.place(chain_of(rigid_block, n), row, ROW(0), shape, base_rotation, A, B)
    for i in range(3):
        pose[i] = shape.tcp_position[i]
        for j in range(3):
            pose[3 + 3 * i + j] = shape.tcp_rotation[i, j]


def block_of(chain: Chain, rigid: Chain) -> Array:
    """Return what the compiled correction of one setpoint keeps: ``kernels.single.correct``."""
    own = np.zeros(chain.mass.shape[0] + SCRATCH)
    return np.concatenate([arm_block(chain), own, arm_block(rigid), np.zeros(24)])


def _parts(block: Array, n: int) -> tuple[Array, Array, Array, Array]:
    """Return chain, row, shape, and what else is in a block, as views of it."""
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
        self._chain, self._row, self._shape, rest = _parts(self._block, n)
        self._offset = rest[:n]
        rest = rest[n + SCRATCH :]
        self._rigid, self._rigid_row, self._rigid_shape, rest = _parts(rest, n)
        self._wanted = rest[:12]
        self._view = view_row(self._row, n)
        self._conditions = model.conditions()
        self._settling = settling(model.terms)
        # one compiled call does it all: links are stiff, and no effect looks at the joint angles
        self._plain = not (chain.flexibility.any() or self._conditions or self._settling)
        self._pose = np.zeros(12)
        # what acts where nothing is given
        self._mass, self._wrench = np.array([float(model.payload_mass)]), np.zeros((1, 6))
        self._cog = np.array(model.payload_cog, dtype=float).reshape(1, 3)

    def correct(self, nominal_q: Array, loads: Loads | None = None) -> Correction:
        """Return the corrected setpoint for ``nominal_q`` (n,); ``loads`` holds one row.

        The wanted pose is the rigid, effect-free arm's at ``nominal_q``. Where servos are known to
        rest elsewhere than commanded, the setpoint makes up for that too. A row that cannot be
        solved comes back with the distance left in ``residual`` (inf: no equilibrium).
        """
        n, loads = self._n, loads or NOTHING
        found, nominal = np.empty(n + 6), np.ascontiguousarray(nominal_q, dtype=float)
        q, moved = found[:n], found[n:]
        if self._plain:
            mass, cog, wrench = loads.payload_mass, loads.payload_cog, loads.wrench
            best, steps = single.correct(
                self._block, nominal, self._mass if mass is None else mass,
                self._cog if cog is None else cog, self._wrench if wrench is None else wrench,
                found,
            )  # fmt: skip
        else:
            rigid = self._rigid
            _rigid_pose(rigid, self._rigid_row, self._rigid_shape, nominal, self._wanted)
            best, steps = self._solve_conditioned(nominal, loads, q)
            self._offset[:] = q - nominal if best < np.inf else 0.0
            self._lead(loads, q)
            _rigid_pose(rigid, self._rigid_row, self._rigid_shape, q, self._pose)
            single.motion(self._wanted, self._pose, bool((q != nominal).any()), moved)
        return Correction(q, moved, best, steps)

    def correct_rows(self, nominal_q: Array, loads: Loads) -> Correction:
        """Return the corrected setpoints for ``nominal_q`` (N, n), as ``correct`` does."""
        n, count = self._n, len(nominal_q)
        nominal = np.ascontiguousarray(nominal_q, dtype=float)
        found, residual = np.empty((count, n + 6)), np.empty(count)
        steps = np.empty(count, dtype=np.int64)
        if self._plain:
            self._plain_rows(nominal, loads, (found, residual, steps))
        else:
            for r in range(count):
                one = self.correct(nominal[r], loads[r : r + 1])
                found[r, :n], found[r, n:] = one.q, one.offset_in_base
                residual[r], steps[r] = one.residual, one.steps
        return Correction(found[:, :n], found[:, n:], residual, steps)

    def _plain_rows(self, nominal: Array, loads: Loads, out: tuple[Array, Array, Index]) -> None:
        """Write the corrections of rows that nothing but the chain's bending changes.

        In blocks; then, one after the other, those that the blocks leave: near singularities.
        """
        rows, chain = self.model.rows(nominal, loads), self.model.chain()
        rigid = self.model.without_terms().chain()

        def work(first: int, last: int) -> None:
            correct_blocks(chain, rigid, rows, first, last, out)

        in_ranges(work, len(nominal))
        left = np.flatnonzero(out[2] == 0)
        if len(left):
            some = tuple(part[left] for part in out)
            given = [part[left] for part in (rows.q, *rows[2:])]
            single.correct_rows(self._block, *given, some)
            for part, values in zip(out, some, strict=True):
                part[left] = values

    def forget(self) -> None:
        """Begin the next correction from nothing, whatever was solved last."""
        self._offset[:] = 0.0
        self._shape[:] = 0.0

    def _solve_conditioned(self, nominal: Array, loads: Loads, q: Array) -> tuple[float, int]:
        """Solve where links bend, or effects look at the joint angles anew in each step."""
        best, steps, row, offset = np.inf, 0, self._view, self._offset
        q[:] = nominal
        for steps in range(1, MAX_STEPS + 1):  # noqa: B007
            tried = nominal + offset
            self._load(loads)
            row.q[0], row.link_scale[0] = tried, 1.0
            self.model.condition(row, loads, tried[None], self._conditions)
            distance = next_offset(self._chain, self._row, self._shape, self._wanted, offset)
            if distance < 0:
                break
            if distance < best:
                q[:], best = tried, distance
            if distance < TOLERANCE:
                break
        return best, steps

    def _lead(self, loads: Loads, q: Array) -> None:
        """Change encoder angles ``q`` (n,) into the commands whose servos rest there."""
        if not self._settling:
            return
        shape = view_shape(self._shape, self._n)
        held = -np.sum(shape.axis * shape.moment, axis=1)[None]
        wanted, command = q.copy(), q[None].copy()
        for _ in range(LEADS):
            rests = command
            for term in self._settling:
                effect = CATALOGUE[term.effect]
                rests = effect.settle(term, self.model.arm, rests, held, loads.approach)
            command = command + (wanted - rests)
        q[:] = command[0]

    def _load(self, loads: Loads) -> None:
        """Write what acts into the row's own buffers."""
        row, mass, cog, wrench = self._view, loads.payload_mass, loads.payload_cog, loads.wrench
        row.payload_mass[0] = (self._mass if mass is None else mass)[0]
        row.payload_cog[0] = (self._cog if cog is None else cog)[0]
        row.wrench[0] = (self._wrench if wrench is None else wrench)[0]


def correct(model: Model, nominal_q: Array, loads: Loads | None = None) -> Correction:
    """Return the corrected setpoints of many rows (N, n), as ``Compensator.correct`` does."""
    q = np.atleast_2d(np.asarray(nominal_q, dtype=float))
    # what slipped once has slipped: setpoints are for what comes
    return Compensator(model).correct_rows(q, replace(loads or Loads(), time=None))


def wanted_pose(model: Model, nominal_q: Array) -> Poses:
    """Return the poses that setpoints ``nominal_q`` (N, n) mean: the rigid, effect-free arm's."""
    return model.rigid_pose(np.atleast_2d(nominal_q))
