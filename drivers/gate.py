"""The last check before a setpoint is sent: every setpoint of every driver passes it.

It shares no code and no memory with the limiter (core/limits.py). It checks joint limits, the TCP
offset (by its own forward kinematics), and the step from the setpoint sent last, timed by this
machine's clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from gapbridge.core.arrays import Array
from gapbridge.core.errors import GateError
from gapbridge.core.kernels.reference import JIT
from gapbridge.core.model import Model
from gapbridge.core.state import Setpoint

MAX_STEP_CYCLES = 5.0  # no step is larger than the rates allow in this many cycles
MAX_WIRE_DELAY = 0.04  # s for which a link may delay setpoints and then send them in a burst
CLOCK_RATIO = 1.02  # largest ratio of the controller's clock rate to this machine's
START = 0.05  # rad from where the arm was when armed to the first setpoint (the arm may sag)
SECOND_ORDER = 1.05  # the offset that joints realise has the limited length to first order only
DEFAULT_VELOCITY = math.pi  # rad/s: of joints whose limit is not known
ROUNDING = 1e-9  # rad, m: tolerance of every comparison
MAX_OFFSET, MAX_OFFSET_ROTATION = 0.1, 0.5  # m, rad: the largest offset that any cell may allow

PASSED, NOT_FINITE, OUTSIDE, LONG_OFFSET, LARGE_ROTATION, JOINT_OFFSET, STEP, RATE, FAR_START = (
    range(9)
)


@dataclass(frozen=True)
class GateBounds:
    """Limits of setpoints: m, rad, m/s, rad/s. The defaults are those of a cell file."""

    offset: float = 0.010
    offset_rotation: float = 0.02
    offset_rate: float = 0.05
    offset_rotation_rate: float = 0.1
    joint_offset: float = 0.05
    joint_velocity: float | None = None
    velocity_share: float = 1.0


@njit(**JIT)
def _copy(frame, out):  # type: ignore[no-untyped-def]
    """Copy a frame (3, 4); ``out[:] = frame`` would compile an error message too."""
    for a in range(3):
        for b in range(4):
            out[a, b] = frame[a, b]


@njit(**JIT)
def _place(links, q, frame, turn):  # type: ignore[no-untyped-def]
    """Write the TCP's frame (3, 4) at joints q (n,); ``links`` (n + 1, 3, 4) end with the tool."""
    _copy(links[0], frame)
    for i in range(q.shape[0]):
        c, s = math.cos(q[i]), math.sin(q[i])
        for a in range(3):
            x, y = frame[a, 0], frame[a, 1]
            frame[a, 0] = c * x + s * y
            frame[a, 1] = c * y - s * x
        for a in range(3):
            for b in range(4):
                turn[a, b] = frame[a, 3] if b == 3 else 0.0
                for k in range(3):
                    turn[a, b] += frame[a, k] * links[i + 1, k, b]
        _copy(turn, frame)


@njit(**JIT)
def _gap(a, b):  # type: ignore[no-untyped-def]
    """Return the distance (m) and the angle (rad) between two frames (3, 4)."""
    square = trace = 0.0
    for k in range(3):
        square += (a[k, 3] - b[k, 3]) ** 2
    sine = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        component = 0.0
        for m in range(3):
            component += a[j, m] * b[i, m] - a[i, m] * b[j, m]
            trace += a[k, m] * b[k, m]
        sine += component * component
    return math.sqrt(square), math.atan2(math.sqrt(sine), trace - 1.0)


@njit(**JIT)
def _length(vector, first):  # type: ignore[no-untyped-def]
    return math.sqrt(vector[first] ** 2 + vector[first + 1] ** 2 + vector[first + 2] ** 2)


@njit(**JIT)
def _judge_joints(links, joints, numbers, first):  # type: ignore[no-untyped-def]
    """Return what ``_judge`` does, for joint setpoints."""
    n, travel = joints.shape[1], 0.0
    q, nominal, last = joints[0], joints[1], joints[2]
    here, there, was = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    scratch = np.empty((3, 4))
    _place(links, q, here, scratch)
    _place(links, nominal, there, scratch)
    length, turn = _gap(here, there)
    nearer = True
    for i in range(n):
        lag = abs(last[i] - nominal[i])
        nearer = nearer and abs(q[i] - nominal[i]) <= lag + ROUNDING
        lag = max(lag, abs(last[i] - joints[6, i]))
        if abs(q[i] - nominal[i]) > max(numbers[4], lag) + ROUNDING:
            return JOINT_OFFSET, i, abs(q[i] - nominal[i]), 0.0
        if not first:  # before the first setpoint the arm may have sagged
            travel = max(travel, (abs(q[i] - last[i]) - ROUNDING) / joints[5, i])
    if not nearer and (
        length > numbers[0] * SECOND_ORDER + ROUNDING or turn > numbers[1] * SECOND_ORDER + ROUNDING
    ):
        # a command that lags by the joints' velocity limits may be far from its goal, or have an
        # offset left from a wider envelope, but it must not move away: it is no farther from its
        # goal than the last command is from this goal, or was from its own
        _place(links, last, was, scratch)
        far, turned = _gap(was, there)
        _place(links, joints[6], there, scratch)
        before, turned_before = _gap(was, there)
        far, turned = max(far, before), max(turned, turned_before)
        if length > max(numbers[0] * SECOND_ORDER, far) + ROUNDING:
            return LONG_OFFSET, -1, length, 0.0
        if turn > max(numbers[1] * SECOND_ORDER, turned) + ROUNDING:
            return LARGE_ROTATION, -1, turn, 0.0
    return PASSED, -1, 0.0, travel


@njit(**JIT)
def _judge_offsets(offsets, numbers, length, turn):  # type: ignore[no-untyped-def]
    """Return what ``_judge`` does, for TCP offsets."""
    if length > numbers[0] * (1.0 + ROUNDING) + ROUNDING:
        return LONG_OFFSET, -1, length, 0.0
    if turn > numbers[1] * (1.0 + ROUNDING) + ROUNDING:
        return LARGE_ROTATION, -1, turn, 0.0
    shift, angle = 0.0, 0.0
    for k in range(3):
        shift += (offsets[0, k] - offsets[1, k]) ** 2
        angle += (offsets[0, 3 + k] - offsets[1, 3 + k]) ** 2
    shift, angle = math.sqrt(shift) - ROUNDING, math.sqrt(angle) - ROUNDING
    travel = max(shift / numbers[2], angle / numbers[3])
    return PASSED, -1, 0.0, travel


@njit(**JIT)
def _judge(links, joints, offsets, numbers, budget, moves, first):  # type: ignore[no-untyped-def]
    """Return (reason, joint, value found, time (s) that the step takes at the limiting rates).

    joints (7, n): q, nominal, last q, lower, upper, velocity, last nominal. offsets (2, 6): this,
    last. numbers: envelope, its rotation, its rates, joint offset, longest step (s). first: nothing
    was sent yet, and last q is the arm's position when it was armed.
    """
    n, q, nominal = joints.shape[1], joints[0], joints[1]
    for i in range(n):
        if not (math.isfinite(q[i]) and math.isfinite(nominal[i])):
            return NOT_FINITE, i, q[i], 0.0
    for k in range(6):
        if not math.isfinite(offsets[0, k]):
            return NOT_FINITE, -1, offsets[0, k], 0.0
    for i in range(n):
        if not joints[3, i] - ROUNDING <= q[i] <= joints[4, i] + ROUNDING:
            return OUTSIDE, i, q[i], 0.0
    length, turn = _length(offsets[0], 0), _length(offsets[0], 3)
    if moves:
        if length > MAX_OFFSET * SECOND_ORDER:
            return LONG_OFFSET, -1, length, 0.0
        if turn > MAX_OFFSET_ROTATION * SECOND_ORDER:
            return LARGE_ROTATION, -1, turn, 0.0
        reason, joint, value, travel = _judge_joints(links, joints, numbers, first)
    else:
        reason, joint, value, travel = _judge_offsets(offsets, numbers, length, turn)
    if reason != PASSED:
        return reason, joint, value, 0.0
    if travel > numbers[5] * (1.0 + ROUNDING):
        return STEP, -1, travel, 0.0
    if travel > budget:
        return RATE, -1, travel, 0.0
    return PASSED, -1, 0.0, max(travel, 0.0)


class Gate:
    """Checks the setpoints of one link; ``begin`` opens the gate and ``end`` shuts it.

    ``clock`` gives the time (s) between setpoints. A check takes some microseconds.
    """

    def __init__(
        self, rate: float, model: Model, moves_arm: bool,
        clock: Callable[[], float],
    ) -> None:  # fmt: skip
        arm = model.arm
        n = arm.n
        self._shapes = ((n,), (n,), (6,))
        links = np.array(arm.link_in_link[:, :3, :], dtype=float)
        links[n] = (arm.link_in_link[n] @ model.tool_in_flange)[:3, :]
        self._links = np.ascontiguousarray(links)
        self._arm_velocity = np.where(
            np.isfinite(arm.limits.velocity), arm.limits.velocity, DEFAULT_VELOCITY
        )
        self._joints = np.zeros((7, n))
        self._joints[3], self._joints[4] = arm.limits.lower, arm.limits.upper
        self._offsets, self._numbers = np.zeros((2, 6)), np.zeros(6)
        self._moves_arm = moves_arm
        self._longest = MAX_STEP_CYCLES / rate  # s
        self._most = self._longest + max(MAX_WIRE_DELAY, MAX_STEP_CYCLES / rate)  # s
        self._started: tuple[Array, Array] | None = None  # rad, until a setpoint is sent
        self._open = False
        self._budget = self._at = self._travel = 0.0  # s
        self._clock = clock
        self._before = self._state()
        self.bounds = GateBounds()
        self.set_bounds(self.bounds)
        self._judged(0.0)  # compiles the kernel: the first setpoint must not wait for it

    def set_clock(self, clock: Callable[[], float]) -> None:
        """Measure time by another clock (s) than this machine's monotonic one."""
        self._clock = clock

    def set_bounds(self, bounds: GateBounds) -> None:
        """Use these limits from now on."""
        self.bounds = bounds
        velocity = bounds.velocity_share * self._arm_velocity
        if bounds.joint_velocity is not None:
            velocity = np.minimum(velocity, bounds.joint_velocity)
        self._joints[5] = velocity
        self._numbers[:] = (
            bounds.offset, bounds.offset_rotation, bounds.offset_rate, bounds.offset_rotation_rate,
            bounds.joint_offset, self._longest,
        )  # fmt: skip

    def begin(self, *start_q: Array) -> None:
        """Open for a stream that begins without an offset.

        ``start_q``: target and actual joints of the arm when armed, (n,) rad; one of them will do.
        """
        self._started = (start_q[0].copy(), start_q[-1].copy())
        self._offsets[:] = 0.0
        self._open, self._budget, self._at = True, self._most, self._clock()

    def end(self) -> None:
        """Refuse every setpoint until ``begin``."""
        self._open, self._started = False, None

    def check(self, setpoint: Setpoint) -> None:
        """Raise GateError, a WriteError, for a setpoint that must not be sent."""
        if not self._open:
            raise GateError("found a setpoint, expected arm() first")
        joints, offsets = self._joints, self._offsets
        shapes = setpoint.q.shape, setpoint.nominal_q.shape, setpoint.offset_in_base.shape
        if shapes != self._shapes:
            raise GateError(f"gate: found shapes {shapes}, expected {self._shapes}")
        joints[0], joints[1] = setpoint.q, setpoint.nominal_q
        offsets[0] = setpoint.offset_in_base
        if self._started is not None:
            self._check_start(joints[0])
        budget = min(self._budget + CLOCK_RATIO * max(self._clock() - self._at, 0.0), self._most)
        code, joint, value, self._travel = self._judged(budget)
        if code != PASSED:
            raise GateError(self._reason(code, joint, value))

    def _judged(self, budget: float) -> tuple[int, int, float, float]:
        code, joint, value, travel = _judge(
            self._links, self._joints, self._offsets, self._numbers, budget, self._moves_arm,
            self._started is not None,
        )  # fmt: skip
        return int(code), int(joint), float(value), float(travel)

    def _check_start(self, q: Array) -> None:
        assert self._started is not None
        was, is_at = self._started
        start_q = np.where(np.abs(q - was) <= np.abs(q - is_at), was, is_at)
        away = np.abs(q - start_q)
        if self._moves_arm and not (away <= START).all():  # NaN is not
            raise GateError(self._reason(FAR_START, int(np.argmax(away)), float(away.max())))
        self._joints[2] = start_q
        self._joints[6] = start_q  # where it stands it has no offset yet

    def _state(self) -> tuple[Array, Array, Array, tuple[Array, Array] | None]:
        joints = self._joints
        return joints[2].copy(), joints[6].copy(), self._offsets[1].copy(), self._started

    def take_back(self) -> None:
        """Judge from the setpoint before the one sent last, which never took effect."""
        self._joints[2], self._joints[6], self._offsets[1], self._started = self._before

    def sent(self) -> None:
        """Record that the setpoint checked last was sent."""
        self._before = self._state()
        now = self._clock()
        self._budget = min(self._budget + CLOCK_RATIO * max(now - self._at, 0.0), self._most)
        self._budget, self._at, self._travel = self._budget - self._travel, now, 0.0
        self._joints[2], self._joints[6] = self._joints[0], self._joints[1]
        self._offsets[1] = self._offsets[0]
        self._started = None

    def _reason(self, code: int, joint: int, value: float) -> str:
        where = f"gate: joint {joint + 1}: " if joint >= 0 else "gate: "
        lower, upper = self._joints[3, joint], self._joints[4, joint]
        bounds, takes = self.bounds, f"found a step that takes {1e3 * value:.1f} ms at the rates"
        message = {
            NOT_FINITE: f"found {value}, expected a finite number",
            OUTSIDE: f"found {value:.4f} rad, expected {lower:.4f} to {upper:.4f}",
            LONG_OFFSET: f"found an offset of {value:.6f} m, expected at most {bounds.offset:g}",
            LARGE_ROTATION: f"found an offset of {value:.6f} rad, expected at most "
            f"{bounds.offset_rotation:g}",
            JOINT_OFFSET: f"found {value:.4f} rad from its nominal setpoint, expected at most "
            f"{bounds.joint_offset:g}",
            STEP: f"{takes}, expected at most {1e3 * self._longest:.1f} ms",
            RATE: f"{takes}, more than has passed",
            FAR_START: f"found a first setpoint {value:.4f} rad from the arm, expected at most "
            f"{START}",
        }
        return where + message[code]
