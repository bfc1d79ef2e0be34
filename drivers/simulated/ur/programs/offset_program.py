"""Emulation of the shipped offset program, for robots that run their own program.

A client streams a Cartesian offset in base axes through RTDE input registers; the program adds it
to the robot's own motion through the inverse kinematics of the nominal arm. Registers:

=========================  ====================================================================
input_double_register_18   offset x, m; 19 y, 20 z, 21 rotation vector x (rad), 22 y
input_int_register_18      rotation vector z in 1e-9 rad
input_int_register_19      sequence number
input_int_register_20      checksum: sum of round(1e9 v) over the six, plus register 22, plus 31
                           sequence, mod 2^31
input_int_register_21      heartbeat: any change
input_int_register_22      rates: 65536 times m/s in 4e-5, plus rad/s in 1e-4
output_int_register_12     sequence of the last offset that was accepted
output_int_register_13     1 running, 2 watchdog expired (ramping to zero), 3 bad checksum or rates
output_double_register_12  applied offset: 12 to 17, x, y, z, rotation vector
=========================  ====================================================================
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from gapbridge.drivers.simulated.plant.kinematics import Joints, offset_frame, solve, tcp_in_base
from gapbridge.drivers.simulated.plant.motion import Hold, Motion, MoveJoints
from gapbridge.drivers.simulated.plant.plant_settings import Vector6
from gapbridge.drivers.simulated.ur.controller import CYCLE, Controller, ScriptError, Steps

NAME = "gapbridge_offset"
RUNNING, EXPIRED, REJECTED = 1, 2, 3
HEARTBEAT_LIMIT = 0.2  # s without a change
SHIFT_STEP = 1.0e-4  # m per cycle, at most
TURN_STEP = 2.0e-4  # rad per cycle, at most
RATE_UNITS = 4.0e-5, 1.0e-4  # m/s and rad/s per count

NOTHING: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_DOUBLES = tuple(f"input_double_register_{i}" for i in range(18, 23))
_APPLIED = tuple(f"output_double_register_{i}" for i in range(12, 18))


def checksum(offset: Sequence[float], sequence: int, rates: int) -> int:
    """Return the checksum of an offset (m, rad) with its sequence number and rates."""
    return (sum(round(v * 1e9) for v in offset) + rates + 31 * sequence) % 2**31


class OffsetMotion:
    """The robot's own motion with the applied offset added."""

    done = False
    scaled = False
    failed = False

    def __init__(self, controller: Controller, own: Motion) -> None:
        self.own = own
        self.applied: Vector6 = NOTHING
        self._controller = controller
        self._nominal: Joints = controller.target_q
        self._rate: Joints = (0.0,) * len(self._nominal)

    def apply(self, offset: Vector6) -> None:
        """Put another offset on top: m, rad, base axes."""
        self.applied = offset

    def move_own(self, goal: Joints, speed: float, acceleration: float) -> None:
        """Move the robot's own motion to `goal` (n, rad)."""
        self.own = MoveJoints(self._nominal, goal, speed, acceleration)

    def restart(self, q: Joints) -> None:
        """Continue after a pause: the own motion restarts from `q` without the offset."""
        if self.applied != NOTHING:
            x, y, z, rx, ry, rz = (-v for v in self.applied)
            arm, tool = self._controller.plant.arm, self._controller.declared.tool
            bare = offset_frame(tcp_in_base(arm, q, tool), (x, y, z, rx, ry, rz))
            q = solve(arm, bare, self._nominal, tool) or self._nominal
        self._nominal = q
        self.own.restart(q)

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """Return the next joint target: the own motion's plus the offset."""
        scaled = dt * self._controller.memory["speed_scaling"] if self.own.scaled else dt
        new = self.own.step(self._nominal, self._rate, scaled)
        if new is not self._nominal or any(self._rate):
            self._rate = tuple((b - a) / dt for a, b in zip(self._nominal, new, strict=True))
        self._nominal = new
        if self.applied == NOTHING:
            return new
        controller = self._controller
        arm, tool = controller.plant.arm, controller.declared.tool
        wanted = offset_frame(tcp_in_base(arm, new, tool), self.applied)
        joints = solve(arm, wanted, q, tool, steps=20)
        if joints is None:
            raise ScriptError("get_inverse_kin: no joints for the offset pose")
        return joints


class OffsetRegisters:
    """The client's inputs, checked, and the program's answers."""

    def __init__(self, memory: dict[str, Any]) -> None:
        self._memory = memory
        self.wanted: Vector6 = NOTHING
        self.steps = (SHIFT_STEP, TURN_STEP)  # m, rad: of one cycle
        self._sequence = int(memory["input_int_register_19"])
        self._heartbeat = memory["input_int_register_21"]
        self._silent = 0.0
        self._rejected = False

    def cycle(self, dt: float) -> int:
        """Process new inputs; returns the program's state."""
        memory = self._memory
        if memory["input_int_register_21"] != self._heartbeat:
            self._heartbeat, self._silent = memory["input_int_register_21"], 0.0
        else:
            self._silent += dt
        if memory["input_int_register_19"] != self._sequence:
            self._take(memory)
        if self._silent > HEARTBEAT_LIMIT + 0.5 * dt:  # as many cycles as the script counts
            self.wanted = NOTHING
            return EXPIRED
        return REJECTED if self._rejected else RUNNING

    def _take(self, memory: Mapping[str, Any]) -> None:
        """Accept a new offset whose checksum fits; a torn or wrong one is reported and ignored."""
        sequence = int(memory["input_int_register_19"])
        x, y, z, rx, ry = (float(memory[name]) for name in _DOUBLES)
        offset: Vector6 = (x, y, z, rx, ry, memory["input_int_register_18"] * 1e-9)
        fits = all(map(math.isfinite, offset))
        rates = int(memory["input_int_register_22"])
        fits = fits and checksum(offset, sequence, rates) == memory["input_int_register_20"]
        shift, turn = divmod(rates, 65536)
        fits = fits and shift >= 1 and turn >= 1  # not so where the registers were cleared
        self._rejected = not fits
        if fits:
            self.steps = (
                min(CYCLE * RATE_UNITS[0] * shift, SHIFT_STEP),
                min(CYCLE * RATE_UNITS[1] * turn, TURN_STEP),
            )
            self._sequence, self.wanted = sequence, offset
            self._memory["output_int_register_12"] = sequence


def approach(now: Vector6, wanted: Vector6, steps: tuple[float, float]) -> Vector6:
    """Return `now` moved towards `wanted` by at most one cycle's steps, m and rad."""
    parts: list[float] = []
    for first, most in zip((0, 3), steps, strict=True):
        here, goal = list(now[first : first + 3]), list(wanted[first : first + 3])
        length = math.dist(here, goal)
        share = 1.0 if length <= most else most / length
        parts.extend(a + share * (b - a) for a, b in zip(here, goal, strict=True))
    a, b, c, d, e, f = parts
    return (a, b, c, d, e, f)


def offset_program(controller: Controller) -> Steps:
    """Run the offset program until something else is started or it is stopped."""
    memory = controller.memory
    registers = OffsetRegisters(memory)
    motion = OffsetMotion(controller, Hold())
    memory["output_int_register_12"] = 0
    controller.start_motion(motion)
    try:
        while True:
            state = registers.cycle(CYCLE)
            motion.apply(approach(motion.applied, registers.wanted, registers.steps))
            memory["output_int_register_13"] = state
            memory.update(zip(_APPLIED, motion.applied, strict=True))
            yield
    finally:
        memory["output_int_register_13"] = 0
        memory.update(zip(_APPLIED, NOTHING, strict=True))
