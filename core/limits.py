"""The limiter of all setpoints before they are sent.

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
from gapbridge.core.state import CLAMPS, ENVELOPE, JOINT_LIMIT, JOINT_OFFSET, RATE, VELOCITY

MAX_GAP_CYCLES = 5.0  # of the time between setpoints that counts for the rate limits
MAX_MAGNITUDE = 1e6  # rad, m, of any number of a setpoint
# m, rad, rad: the largest offsets that any cell may allow, and so the largest in force at a start
MAX_OFFSET, MAX_OFFSET_ROTATION, MAX_JOINT_OFFSET = 0.1, 0.5, 0.5
SCALARS = 7  # scalar limits, first in the limiter's block
SLACK = 1.0 - 1e-12  # keeps rounding on the allowed side

_OK, _NOT_FINITE, _GAP_NOT_POSITIVE, _OUTSIDE_LIMITS, _JUMP, _TOO_FAR, _LAGS = range(7)


@dataclass(frozen=True)
class Limits:
    """The limits of every setpoint.

    offset, offset_rotation: length of the TCP offset, m, and of its rotation vector, rad.
    offset_rate, offset_rotation_rate: how fast the offset may change, m/s and rad/s.
    joint_offset: correction of any one joint, rad.
    lower, upper: joint limits (n,), rad.
    velocity: of each joint's command (n,), rad/s.
    following: farthest a command may be from the actual joint, and the nominal setpoint from the
    nominal joints reached, rad.
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
        """Raise LimitError for limits that are not positive, not ordered or not numbers."""
        for field in fields(self):
            value = np.asarray(getattr(self, field.name), dtype=float)
            if np.isnan(value).any():
                raise LimitError(f"limits: {field.name}: found {value}, expected numbers")
            if field.name not in ("lower", "upper") and (value <= 0.0).any():
                raise LimitError(f"limits: {field.name}: found {value}, expected more than 0")
        if (np.asarray(self.lower) >= np.asarray(self.upper)).any():
            raise LimitError("limits: found a lower joint limit above the upper one")


class Limited(NamedTuple):
    """The limited setpoint; the arrays are the limiter's buffers, valid until its next call.

    A tuple, because one is made in every cycle.
    """

    q: Array  # (n,) rad, the command
    offset_in_base: Array  # (6,) m, rad: the TCP offset that the command carries
    clamped: int  # bits: 1 << ENVELOPE, ...


class Limiter:
    """Limits one stream of setpoints. Deterministic, with almost no allocation, never sleeps.

    For any input, the output of ``limit`` is finite, inside the envelope, within the joint limits,
    and no step is larger than allowed. An offset beyond the envelope at the start never grows, and
    comes inside within the rate limits.
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
                   MAX_GAP_CYCLES * limits.cycle]  # fmt: skip
        bounds = (limits.lower, limits.upper, limits.velocity)
        # one block, to pass a single array to compiled code
        self._block = np.concatenate([numbers, *bounds, np.zeros(4 * n + 6)])
        self._q, self._nominal, self._reached, self._delta, self._offset = _state_views(self._block)
        self._out = _read_only(self._q), _read_only(self._offset)
        self._state = self._block[SCALARS + 3 * n :]
        self._kept = self._state.copy()
        self._q[:] = self._nominal[:] = np.nan

    @property
    def started(self) -> bool:
        """Return whether ``start`` has been called since the last ``reset``."""
        return bool(np.isfinite(self._q[0]))

    @property
    def joint_offset(self) -> Array:
        """Return the last joint offset (n,), rad: a read-only view."""
        return _read_only(self._delta)

    @property
    def offset_in_base(self) -> Array:
        """Return a copy of the last TCP offset (6,), m and rad."""
        return self._offset.copy()

    def start(
        self, q: Array, delta: Array | None = None, offset_in_base: Array | None = None
    ) -> None:
        """Start a stream at the present command ``q`` (n,), rad.

        ``delta`` (n,), rad, and its TCP offset (6,) are the part of it that is a correction
        already; default: none. An offset left in the arm under a wider envelope is taken, because
        only from where the arm is it ramps in without a jump. Raises LimitError where they are not
        finite, the joints outside their limits, or the offset larger than any cell allows.
        """
        if not np.isfinite(q).all():
            raise LimitError(f"start: found {q}, expected finite joints")
        if (q < self.limits.lower).any() or (q > self.limits.upper).any():
            raise LimitError(f"start: found {q}, expected joints within their limits")
        delta = np.zeros(len(self._q)) if delta is None else delta
        offset = np.zeros(6) if offset_in_base is None else offset_in_base
        self._require_possible(delta, offset)
        self._q[:], self._delta[:], self._offset[:] = q, delta, offset
        self._nominal[:] = self._reached[:] = q - self._delta

    def _require_possible(self, delta: Array, offset_in_base: Array) -> None:
        """Raise LimitError for an offset that is not finite, or larger than any cell allows."""
        limits = self.limits
        for what, size, most in (
            ("joint offset", np.abs(delta).max(), max(MAX_JOINT_OFFSET, limits.joint_offset)),
            ("TCP offset", np.linalg.norm(offset_in_base[:3]), max(MAX_OFFSET, limits.offset)),
            ("TCP rotation", np.linalg.norm(offset_in_base[3:]),
             max(MAX_OFFSET_ROTATION, limits.offset_rotation)),
        ):  # fmt: skip
            if not size <= most * (1.0 + 1e-9):  # nor where it is no number
                raise LimitError(f"start: {what}: found {size:.4g}, expected at most {most:g}")

    def settle(self) -> None:
        """Take the nominal joints that the command has reached as the last nominal setpoint.

        A command that lags behind its setpoints brakes from where it is.
        """
        self._nominal[:] = self._reached

    @property
    def reached(self) -> Array:
        """Return the nominal joints that the command has reached (n,), rad: a read-only view."""
        return _read_only(self._reached)

    @property
    def lag(self) -> float:
        """Return how far the last command is from its goal, rad: the velocity limited it."""
        return float(np.abs(self._nominal + self._delta - self._q).max())

    def keep(self) -> None:
        """Remember the present state for ``take_back``."""
        self._kept[:] = self._state

    def take_back(self) -> None:
        """Return to the state of the last ``keep``: what was limited since is not in force."""
        self._state[:] = self._kept

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
        """Return the limited setpoint, ``dt`` s after the last one.

        The target offset is ``ramp`` (0..1) times the correction ``corrected_q - nominal_q`` (n,)
        with its TCP offset (6,), approached within the rate limits; a ramp of zero brings it to
        zero. A command limited by the velocity continues towards its target in the next cycle.
        Raises LimitError, without any change of state, where a number is not finite, the nominal
        setpoint is outside the joint limits or has jumped, or the command would be too far from the
        actual joints or from its goal.
        """
        code, clamped = _limit(
            self._block, nominal_q, corrected_q, offset_in_base, ramp, actual_q, dt
        )
        if code != _OK:
            raise LimitError(self._reason(code, clamped, nominal_q, actual_q, dt))
        if clamped:
            for bit in range(len(CLAMPS)):
                self.counts[bit] += clamped >> bit & 1
        return Limited(*self._out, clamped)

    def _reason(self, code: int, joint: int, nominal_q: Array, actual_q: Array, dt: float) -> str:
        if code == _GAP_NOT_POSITIVE:
            return f"setpoint: found a gap of {dt:g} s to the last one, expected a positive one"
        if code == _OUTSIDE_LIMITS:
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
        if code == _LAGS:
            return (
                f"setpoint: joint {joint + 1} would be more than {self.limits.following:g} rad "
                "behind its nominal setpoint (limits.following): the setpoints are faster than its "
                f"velocity limit of {self.limits.velocity[joint]:.3g} rad/s"
            )
        if code == _TOO_FAR:
            behind = abs(self._q[joint] - actual_q[joint])
            return (
                f"setpoint: joint {joint + 1} is {behind:.4f} rad behind its last command, and "
                f"would be more than {self.limits.following:g} rad behind this one "
                "(limits.following)"
            )
        if not self.started:
            return "setpoint: found no start of the stream, expected start() before limit()"
        return "setpoint: found a number that is not finite, expected finite ones"


def _read_only(array: Array) -> Array:
    """Return a read-only view."""
    view = array.view()
    view.flags.writeable = False
    return view


def _state_views(block: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Return views of the last command, nominal setpoint, nominal joints reached, offsets.

    All (n,); the offsets are the joint offset (n,) and the TCP offset (6,).
    """
    n = (block.shape[0] - SCALARS - 6) // 7
    at = SCALARS + 3 * n
    return (
        block[at : at + n], block[at + n : at + 2 * n], block[at + 2 * n : at + 3 * n],
        block[at + 3 * n : at + 4 * n], block[at + 4 * n :],
    )  # fmt: skip


_compiled_views = njit(**JIT)(_state_views)


@njit(**JIT)
def _shrink(vector, first, last, limit):  # type: ignore[no-untyped-def]
    """Return the factor (<= 1) by which vector[first:last] must shrink to be `limit` long."""
    square = 0.0
    for k in range(first, last):
        square += vector[k] * vector[k]
    length = np.sqrt(square)
    return 1.0 if length <= limit else limit / length * SLACK


@njit(**JIT)
def _finite(q, nominal, corrected, actual, offset, ramp, dt):  # type: ignore[no-untyped-def]
    """Return whether all numbers are finite and below MAX_MAGNITUDE."""
    ok = np.isfinite(ramp) and np.isfinite(dt)
    for i in range(q.shape[0]):
        ok = ok and abs(nominal[i]) < MAX_MAGNITUDE and abs(corrected[i]) < MAX_MAGNITUDE
        ok = ok and abs(actual[i]) < MAX_MAGNITUDE and np.isfinite(q[i])
    for k in range(6):
        ok = ok and abs(offset[k]) < MAX_MAGNITUDE
    return ok


@njit(**JIT)
def _check(bounds, nominal, before, dt):  # type: ignore[no-untyped-def]
    """Return the reason for refusing the setpoint, or _OK."""
    if dt <= 0.0:
        return _GAP_NOT_POSITIVE
    for i in range(nominal.shape[0]):
        if nominal[i] < bounds[0, i] or nominal[i] > bounds[1, i]:
            return _OUTSIDE_LIMITS
    for i in range(nominal.shape[0]):
        # factor 2: a source may catch up one cycle; up to that the command is slowed, not refused
        if abs(nominal[i] - before[i]) > 2.0 * bounds[2, i] * dt:
            return _JUMP
    return _OK


@njit(**JIT)
def _correction_factor(numbers, bounds, nominal, corrected, offset, ramp):  # type: ignore[no-untyped-def]
    """Return the factor on the correction that keeps it within bounds, and the clamped bits."""
    clamped = 0
    factor = min(ramp, _shrink(offset, 0, 3, numbers[0]), _shrink(offset, 3, 6, numbers[1]))
    if factor < ramp:
        clamped |= 1 << ENVELOPE
    for i in range(nominal.shape[0]):
        offset_size = abs(corrected[i] - nominal[i]) * factor
        if offset_size > numbers[4]:
            factor *= numbers[4] / offset_size * SLACK
            clamped |= 1 << JOINT_OFFSET
    for i in range(nominal.shape[0]):
        joint_offset = (corrected[i] - nominal[i]) * factor
        margin = bounds[1, i] - nominal[i] if joint_offset > 0.0 else nominal[i] - bounds[0, i]
        if abs(joint_offset) > margin:
            factor *= margin / abs(joint_offset) * SLACK
            clamped |= 1 << JOINT_LIMIT
    return factor, clamped


@njit(**JIT)
def _limit(block, nominal, corrected, offset, ramp, actual, dt):  # type: ignore[no-untyped-def]
    """Advance the state in the block by one setpoint; returns (reason, clamped bits).

    With _TOO_FAR and _LAGS the second is the joint.
    """
    q, before, reached, delta, applied = _compiled_views(block)
    n = q.shape[0]
    numbers, bounds = block[:SCALARS], block[SCALARS : SCALARS + 3 * n].reshape((3, n))
    if not _finite(q, nominal, corrected, actual, offset, ramp, dt):
        return _NOT_FINITE, 0
    code = _check(bounds, nominal, before, dt)
    if code != _OK:
        return code, 0
    gap = min(dt, numbers[6])
    factor, clamped = _correction_factor(
        numbers, bounds, nominal, corrected, offset, min(max(ramp, 0.0), 1.0)
    )

    # rate limits of the TCP offset
    step = np.empty(6)
    for k in range(6):
        step[k] = factor * offset[k] - applied[k]
    rate_factor = min(_shrink(step, 0, 3, numbers[2] * gap), _shrink(step, 3, 6, numbers[3] * gap))
    if rate_factor < 1.0:
        clamped |= 1 << RATE

    # velocity limits of the joint command: of its nominal part, then with the offset
    pace = 1.0
    for i in range(n):
        way = abs(nominal[i] - reached[i])
        if way > bounds[2, i] * gap:
            pace = min(pace, bounds[2, i] * gap / way * SLACK)
            clamped |= 1 << VELOCITY
    arrives = np.empty(n)
    for i in range(n):
        arrives[i] = nominal[i] if pace == 1.0 else reached[i] + pace * (nominal[i] - reached[i])
        if abs(nominal[i] - arrives[i]) > numbers[5]:
            return _LAGS, i
    goal, speed_factor = np.empty(n), 1.0
    for i in range(n):
        joint_offset = delta[i] + rate_factor * (factor * (corrected[i] - nominal[i]) - delta[i])
        goal[i] = min(max(arrives[i] + joint_offset, bounds[0, i]), bounds[1, i])
        if goal[i] != arrives[i] + joint_offset:
            clamped |= 1 << JOINT_LIMIT
        distance = abs(goal[i] - q[i])
        if distance > bounds[2, i] * gap:
            speed_factor = min(speed_factor, bounds[2, i] * gap / distance * SLACK)
            clamped |= 1 << VELOCITY
    for i in range(n):
        if abs(q[i] + speed_factor * (goal[i] - q[i]) - actual[i]) > numbers[5]:
            return _TOO_FAR, i
    for i in range(n):
        q[i] = goal[i] if speed_factor == 1.0 else q[i] + speed_factor * (goal[i] - q[i])
        delta[i] += rate_factor * (factor * (corrected[i] - nominal[i]) - delta[i])
        before[i], reached[i] = nominal[i], arrives[i]
    for k in range(6):
        applied[k] += rate_factor * step[k]
    return _OK, clamped
