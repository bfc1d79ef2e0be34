"""The one limiter that every setpoint passes on its way out.

A correction is limited as a whole: the joint offset ``corrected_q - nominal_q`` and the TCP offset
that belongs to it shrink by the same factor, so that its direction is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numba import njit

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LimitError
from gapbridge.core.kernels.reference import JIT

LONGEST_GAP = 5.0  # cycles: after a longer one, no more than this many cycles' steps are allowed
HUGE = 1e6  # rad, m: no number of a setpoint is that large
NUMBERS = 7  # limits that are one number each, first in the limiter's block
SLACK = 1.0 - 1e-12  # keeps rounding on the allowed side

ENVELOPE, RATE, JOINT_OFFSET, JOINT_LIMIT, VELOCITY = range(5)
CLAMPS = ("envelope", "rate", "joint_offset", "joint_limit", "velocity")
_FINE, _NOT_FINITE, _BAD_GAP, _NOMINAL_OUTSIDE, _JUMP, _FAR = range(6)


@dataclass(frozen=True)
class Limits:
    """What no setpoint passes.

    offset, offset_rotation: length of the TCP offset, m, and of its rotation vector, rad.
    offset_rate, offset_rotation_rate: how fast the offset may change, m/s and rad/s.
    joint_offset: correction of any one joint, rad.
    lower, upper: joint limits (n,), rad.
    velocity: of each joint's command (n,), rad/s.
    following: farthest a command may be from the actual joint, rad.
    cycle: duration of one cycle, s.
    """

    lower: Array
    upper: Array
    velocity: Array
    offset: float = 0.010
    offset_rotation: float = 0.02
    offset_rate: float = 0.05
    offset_rotation_rate: float = 0.1
    joint_offset: float = 0.05
    following: float = 0.1
    cycle: float = 0.002

    def __post_init__(self) -> None:
        """Refuse limits that limit nothing or forbid everything. Raises LimitError."""
        for field in fields(self):
            value = np.asarray(getattr(self, field.name), dtype=float)
            if np.isnan(value).any():
                raise LimitError(f"limits: {field.name}: found {value}, expected numbers")
            if field.name not in ("lower", "upper") and (value <= 0.0).any():
                raise LimitError(f"limits: {field.name}: found {value}, expected more than 0")
        if (np.asarray(self.lower) >= np.asarray(self.upper)).any():
            raise LimitError("limits: found a lower joint limit above the upper one")


class Limited(NamedTuple):
    """What may leave; the arrays are the limiter's own, read-only, and hold until its next call.

    A tuple, because one is made in every cycle.
    """

    q: Array  # (n,) rad, the command
    offset_in_base: Array  # (6,) m, rad: the TCP offset that the command carries
    clamped: int  # bits: 1 << ENVELOPE, ...


class Limiter:
    """Limits one stream of setpoints. Deterministic, allocates next to nothing, never sleeps.

    Whatever goes in, out of ``limit`` come finite numbers only, inside the envelope, within the
    joint limits, and no step larger than allowed.
    """

    def __init__(self, limits: Limits, n: int) -> None:
        for name in ("lower", "upper", "velocity"):
            if np.shape(getattr(limits, name)) != (n,):
                found = np.shape(getattr(limits, name))
                raise LimitError(f"limits: {name}: found shape {found}, expected ({n},)")
        self.limits = limits
        self.counts = np.zeros(len(CLAMPS), dtype=np.int64)  # of each of CLAMPS
        numbers = [limits.offset, limits.offset_rotation, limits.offset_rate,
                   limits.offset_rotation_rate, limits.joint_offset, limits.following,
                   LONGEST_GAP * limits.cycle]  # fmt: skip
        bounds = (limits.lower, limits.upper, limits.velocity)
        # one block: each array handed to compiled code is unwrapped anew in every call
        self._block = np.concatenate([numbers, *bounds, np.zeros(3 * n + 6)])
        self._q, self._nominal, self._delta, self._offset = _kept(self._block)
        self._out = _read_only(self._q), _read_only(self._offset)
        self._q[:] = self._nominal[:] = np.nan

    @property
    def started(self) -> bool:
        """Return whether ``start`` has been called since the last ``reset``."""
        return bool(np.isfinite(self._q[0]))

    @property
    def joint_offset(self) -> Array:
        """Return the joint offset (n,) that left last, rad: read-only, of this moment."""
        return _read_only(self._delta)

    @property
    def offset_in_base(self) -> Array:
        """Return a copy of the TCP offset (6,) that left last, m and rad."""
        return self._offset.copy()

    def start(
        self, q: Array, delta: Array | None = None, offset_in_base: Array | None = None
    ) -> None:
        """Begin a stream: the arm is commanded to ``q`` (n,) rad.

        ``delta`` (n,) rad of it, with its TCP offset (6,), is an offset that is in force already;
        left out: none is. Raises LimitError where that is not finite or outside the joint limits.
        """
        if not np.isfinite(q).all():
            raise LimitError(f"start: found {q}, expected finite joints")
        if (q < self.limits.lower).any() or (q > self.limits.upper).any():
            raise LimitError(f"start: found {q}, expected joints within their limits")
        if delta is not None and not np.isfinite(delta).all():
            raise LimitError(f"start: found an offset of {delta}, expected finite joints")
        self._q[:] = q
        self._delta[:] = 0.0 if delta is None else delta
        self._nominal[:] = q - self._delta
        self._offset[:] = 0.0 if offset_in_base is None else offset_in_base

    def reset(self) -> None:
        """End the stream; ``limit`` refuses until ``start``."""
        self._q[:] = np.nan

    def limit(
        self,
        nominal_q: Array,
        corrected_q: Array,
        offset_in_base: Array,
        ramp: float,
        actual_q: Array,
        dt: float,
    ) -> Limited:
        """Return what may leave ``dt`` s after the last setpoint.

        The offset wanted is ``ramp`` (0..1) times the correction ``corrected_q - nominal_q`` (n,)
        with its TCP offset (6,); it is approached no faster than the rates allow, so that a ramp
        of zero brings it to zero and keeps it there. A command that the velocity limit holds back
        goes on towards its goal in the next cycle. Raises LimitError, and lets nothing out and
        changes nothing, where a number is not finite, the nominal setpoint is outside the joint
        limits or has jumped, or the command would be too far from the actual joints.
        """
        code, clamped = _limit(
            self._block, nominal_q, corrected_q, offset_in_base, ramp, actual_q, dt
        )
        if code != _FINE:
            raise LimitError(self._reason(code, clamped, nominal_q, actual_q, dt))
        if clamped:
            for bit in range(len(CLAMPS)):
                self.counts[bit] += clamped >> bit & 1
        return Limited(*self._out, clamped)

    def _reason(self, code: int, joint: int, nominal_q: Array, actual_q: Array, dt: float) -> str:
        if code == _BAD_GAP:
            return f"setpoint: found a gap of {dt:g} s to the last one, expected a positive one"
        if code == _NOMINAL_OUTSIDE:
            bad = (nominal_q < self.limits.lower) | (nominal_q > self.limits.upper)
            joint = int(np.argmax(bad))
            return (
                f"setpoint: joint {joint + 1}: found {nominal_q[joint]:.4f} rad, expected "
                f"{self.limits.lower[joint]:.4f} to {self.limits.upper[joint]:.4f}"
            )
        if code == _JUMP:
            joint = int(np.argmax(np.abs(nominal_q - self._nominal) / self.limits.velocity))
            return (
                f"setpoint: joint {joint + 1} jumps by "
                f"{nominal_q[joint] - self._nominal[joint]:+.4f} rad in {dt:.4f} s, more than its "
                f"velocity limit of {self.limits.velocity[joint]:.3g} rad/s allows"
            )
        if code == _FAR:
            away = abs(self._q[joint] - actual_q[joint])
            return (
                f"setpoint: joint {joint + 1} is {away:.4f} rad behind its last command, and would "
                f"be more than {self.limits.following:g} rad behind this one (limits.following)"
            )
        if not self.started:
            return "setpoint: found no start of the stream, expected start() before limit()"
        return "setpoint: found a number that is not finite, expected finite ones"


def _read_only(array: Array) -> Array:
    """Return a view through which nobody else changes the limiter's own numbers."""
    view = array.view()
    view.flags.writeable = False
    return view


def _kept(block: Array) -> tuple[Array, Array, Array, Array]:
    """Return the last command, its nominal joints, joint offset (n,) and TCP offset (6,): views."""
    n = (block.shape[0] - NUMBERS - 6) // 6
    at = NUMBERS + 3 * n
    return (
        block[at : at + n], block[at + n : at + 2 * n], block[at + 2 * n : at + 3 * n],
        block[at + 3 * n :],
    )  # fmt: skip


_kept_of = njit(**JIT)(_kept)


@njit(**JIT)
def _share(vector, first, last, most):  # type: ignore[no-untyped-def]
    """Return the factor (<= 1) by which vector[first:last] must shrink to be `most` long."""
    square = 0.0
    for k in range(first, last):
        square += vector[k] * vector[k]
    length = np.sqrt(square)
    return 1.0 if length <= most else most / length * SLACK


@njit(**JIT)
def _finite(q, nominal, corrected, actual, offset, ramp, dt):  # type: ignore[no-untyped-def]
    """Return whether all is a number, and none of them huge."""
    fine = np.isfinite(ramp) and np.isfinite(dt)
    for i in range(q.shape[0]):
        fine = fine and abs(nominal[i]) < HUGE and abs(corrected[i]) < HUGE
        fine = fine and abs(actual[i]) < HUGE and np.isfinite(q[i])
    for k in range(6):
        fine = fine and abs(offset[k]) < HUGE
    return fine


@njit(**JIT)
def _check(bounds, nominal, before, dt):  # type: ignore[no-untyped-def]
    """Return the reason why nothing may leave, or _FINE."""
    if dt <= 0.0:
        return _BAD_GAP
    for i in range(nominal.shape[0]):
        if nominal[i] < bounds[0, i] or nominal[i] > bounds[1, i]:
            return _NOMINAL_OUTSIDE
    for i in range(nominal.shape[0]):
        # twice: a source may catch up a cycle; what is between is slowed down, not refused
        if abs(nominal[i] - before[i]) > 2.0 * bounds[2, i] * dt:
            return _JUMP
    return _FINE


@njit(**JIT)
def _whole(numbers, bounds, nominal, corrected, offset, ramp):  # type: ignore[no-untyped-def]
    """Return the factor on the whole correction that keeps it in bounds, and the clamped bits."""
    clamped = 0
    share = min(ramp, _share(offset, 0, 3, numbers[0]), _share(offset, 3, 6, numbers[1]))
    if share < ramp:
        clamped |= 1 << ENVELOPE
    for i in range(nominal.shape[0]):
        over = abs(corrected[i] - nominal[i]) * share
        if over > numbers[4]:
            share *= numbers[4] / over * SLACK
            clamped |= 1 << JOINT_OFFSET
    for i in range(nominal.shape[0]):
        turn = (corrected[i] - nominal[i]) * share
        room = bounds[1, i] - nominal[i] if turn > 0.0 else nominal[i] - bounds[0, i]
        if abs(turn) > room:
            share *= room / abs(turn) * SLACK
            clamped |= 1 << JOINT_LIMIT
    return share, clamped


@njit(**JIT)
def _limit(block, nominal, corrected, offset, ramp, actual, dt):  # type: ignore[no-untyped-def]
    """Advance what the block keeps by one setpoint; returns (reason, clamped bits).

    With _FAR the second is the joint.
    """
    q, before, delta, applied = _kept_of(block)
    n = q.shape[0]
    numbers, bounds = block[:NUMBERS], block[NUMBERS : NUMBERS + 3 * n].reshape((3, n))
    if not _finite(q, nominal, corrected, actual, offset, ramp, dt):
        return _NOT_FINITE, 0
    code = _check(bounds, nominal, before, dt)
    if code != _FINE:
        return code, 0
    gap = min(dt, numbers[6])
    share, clamped = _whole(numbers, bounds, nominal, corrected, offset, min(max(ramp, 0.0), 1.0))

    # approached no faster than the rates allow
    step = np.empty(6)
    for k in range(6):
        step[k] = share * offset[k] - applied[k]
    part = min(_share(step, 0, 3, numbers[2] * gap), _share(step, 3, 6, numbers[3] * gap))
    if part < 1.0:
        clamped |= 1 << RATE

    # the joint command with it, no faster than the joints may
    goal, pace = np.empty(n), 1.0
    for i in range(n):
        wanted = delta[i] + part * (share * (corrected[i] - nominal[i]) - delta[i])
        goal[i] = min(max(nominal[i] + wanted, bounds[0, i]), bounds[1, i])
        if goal[i] != nominal[i] + wanted:
            clamped |= 1 << JOINT_LIMIT
        way = abs(goal[i] - q[i])
        if way > bounds[2, i] * gap:
            pace = min(pace, bounds[2, i] * gap / way * SLACK)
            clamped |= 1 << VELOCITY
    for i in range(n):
        if abs(q[i] + pace * (goal[i] - q[i]) - actual[i]) > numbers[5]:
            return _FAR, i
    for i in range(n):
        q[i] = goal[i] if pace == 1.0 else q[i] + pace * (goal[i] - q[i])
        delta[i] += part * (share * (corrected[i] - nominal[i]) - delta[i])
        before[i] = nominal[i]
    for k in range(6):
        applied[k] += part * step[k]
    return _FINE, clamped
