"""The controller: memory of RTDE fields, modes, the running program, one cycle at a time."""

from __future__ import annotations

import logging
import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from gapbridge.drivers.simulated.plant.declared_settings import DeclaredSettings
from gapbridge.drivers.simulated.plant.kinematics import Joints, within_limits
from gapbridge.drivers.simulated.plant.motion import Hold, Motion, Stop
from gapbridge.drivers.simulated.plant.plant import Plant
from gapbridge.drivers.simulated.plant.sensors import Sensors
from gapbridge.drivers.simulated.plant.stream_motion import Servo
from gapbridge.drivers.simulated.ur import modes
from gapbridge.drivers.simulated.ur.rtde_names import INPUTS, OUTPUTS, blank

_DIGITAL = {  # mask field: (value field, first bit in actual_digital_output_bits)
    "standard_digital_output_mask": ("standard_digital_output", 0),
    "configurable_digital_output_mask": ("configurable_digital_output", 8),
    "tool_digital_output_mask": ("tool_digital_output", 16),
}
_BIT_FIELDS = {"input_bit_registers0_to_31": 0, "input_bit_registers32_to_63": 32}
log = logging.getLogger("drivers.simulated")
CYCLE = 0.002  # s
PROGRAM_START = 0.04  # s between the arrival of a program and its first line
DEFAULT_STOP = 12.0  # rad/s^2
HOLD = Hold()
Steps = Generator[None, None, None]


class Program(NamedTuple):
    """A running script: one generator step per cycle."""

    name: str
    steps: Steps


class Watchdog(NamedTuple):
    """Stops the program when a client stops writing an input variable."""

    period: float  # s
    left: float  # s


@dataclass(slots=True)
class Controller:
    """A UR controller's state; the servers read and write it, ``cycle`` advances it by 2 ms."""

    plant: Plant
    declared: DeclaredSettings
    memory: dict[str, Any] = field(default_factory=dict)
    target_q: Joints = ()
    target_qd: Joints = ()
    motion: Motion = HOLD
    paused: Motion = HOLD  # continued after a pause
    largest_servo_step: float = 0.0  # rad, between two setpoints of a servo stream
    program: Program | None = None
    starts_in: float = 0.0  # s until the program's first line
    watchdogs: dict[str, Watchdog] = field(default_factory=dict)
    clock: float = 0.0  # s since the controller started; never stops
    frozen: bool = False  # the timestamp does not change
    stall_until: float = 0.0  # controller clock until which no RTDE packet leaves
    stopped_at: float = -math.inf  # controller clock of the last protective stop
    loaded_program: str = ""
    sensors: Sensors = field(init=False)

    def __post_init__(self) -> None:
        memory = self.memory
        memory.update({name: blank(kind) for name, kind in (OUTPUTS | INPUTS).items()})
        self.target_q = self.plant.q
        self.target_qd = (0.0,) * len(self.target_q)
        memory.update(modes.AT_REST)
        self.sensors = Sensors(self.plant, self.declared, memory)
        self.set_runtime(modes.STOPPED)
        self.refresh()

    # -- the cycle ------------------------------------------------------------------------------

    def cycle(self, dt: float = CYCLE) -> None:
        """Advance program, motion, plant and sensors by one cycle."""
        self.clock += dt
        if not self.frozen:
            self.memory["timestamp"] = self.clock
        if self.watchdogs:
            self._check_watchdogs(dt)
        if self.program is not None:
            self._step_program(self.program, dt)
        self._step_motion(dt)
        self.plant.step(self.target_q, dt)
        self.refresh(dt)

    def _step_program(self, program: Program, dt: float) -> None:
        if self.starts_in > 0.0:
            self.starts_in -= dt
            if self.starts_in <= 0.0:
                self.set_runtime(modes.PLAYING if self.can_move else modes.PAUSED)
            return
        if self.memory["runtime_state"] != modes.PLAYING:
            return
        try:
            next(program.steps)
        except StopIteration:
            self.end_program()
        except ScriptError as error:
            log.warning("program %s stops: %s", program.name, error)
            self.end_program()
        except Exception:
            log.exception("program %s stops", program.name)
            self.end_program()

    def _step_motion(self, dt: float) -> None:
        """Move the joint target by one cycle of the running motion."""
        scaled = dt * self.memory["speed_scaling"] if self.motion.scaled else dt
        try:
            target = self.motion.step(self.target_q, self.target_qd, scaled)
        except ScriptError as error:
            log.warning("motion stops: %s", error)
            self.end_program()
            self.motion = Stop(self.target_qd, DEFAULT_STOP)
            return
        if self.motion.done:
            self.motion = HOLD
        if target != self.target_q and not within_limits(self.plant.arm, target):
            log.warning("joint target %s is outside the joint limits", target)
            self.protective_stop()
            return
        before = self.target_qd
        if target is self.target_q:
            self.target_qd = (0.0,) * len(target)
        else:
            self.target_qd = tuple((b - a) / dt for a, b in zip(self.target_q, target, strict=True))
        self.target_q = target
        memory = self.memory
        memory["target_qdd"] = tuple(
            (b - a) / dt for a, b in zip(before, self.target_qd, strict=True)
        )

    def _check_watchdogs(self, dt: float) -> None:
        if self.program is None:
            self.watchdogs.clear()
            return
        for name, (period, remaining) in list(self.watchdogs.items()):
            self.watchdogs[name] = Watchdog(period, remaining - dt)
            if remaining - dt < 0.0:
                log.warning("watchdog on %s expired, the program stops", name)
                self.end_program()
                return

    def refresh(self, dt: float = CYCLE) -> None:
        """Bring the memory up to the present state."""
        memory, declared = self.memory, self.declared
        memory["target_q"], memory["target_qd"] = self.target_q, self.target_qd
        memory["actual_q"], memory["actual_qd"] = self.plant.q, self.plant.qd
        memory["payload"], memory["payload_cog"] = declared.payload_mass, declared.payload_cog
        memory["payload_inertia"] = declared.payload_inertia
        memory["target_gravity"] = declared.gravity
        memory["tcp_offset"] = declared.tcp
        self.sensors.update(self.target_q, dt)

    # -- programs -------------------------------------------------------------------------------

    def start_program(self, name: str, steps: Steps) -> None:
        """Start a script; a running one ends first. Without brakes released nothing starts."""
        if self.program is not None:
            self.end_program()
        if not self.can_move:
            log.warning("program %s refused: the robot is not running", name)
            return
        log.info("program %s starts", name)
        self.program, self.starts_in = Program(name, steps), PROGRAM_START

    def end_program(self) -> None:
        """End the running script; the arm brakes."""
        program, self.program = self.program, None
        self.watchdogs.clear()
        self.paused = HOLD
        if program is not None:
            program.steps.close()
            log.info("program %s ended", program.name)
        if not isinstance(self.motion, (Stop, Hold)):
            self.motion = Stop(self.target_qd, DEFAULT_STOP)
        self.set_runtime(modes.STOPPED)

    def run_motion(self, motion: Motion) -> Steps:
        """Run a motion to its end, cycle by cycle (for use inside a program).

        Raises ScriptError where the motion cannot be carried on.
        """
        self.start_motion(motion)
        yield
        while not motion.done:
            yield
        if motion.failed:
            raise ScriptError("the line leaves the workspace")

    def start_motion(self, motion: Motion) -> None:
        """Start a motion with the next cycle."""
        self.motion = motion

    def servo(self, goal: Joints, lookahead: float) -> None:
        """Follow a streamed setpoint (n, rad), smoothed over ``lookahead`` s."""
        if isinstance(self.motion, Servo):
            step = max(abs(b - a) for a, b in zip(self.motion.goal, goal, strict=True))
            self.largest_servo_step = max(self.largest_servo_step, step)
            self.motion.aim(goal, lookahead)
        else:
            self.motion = Servo(self.plant.arm, goal, lookahead)

    def load_program(self, name: str) -> None:
        """Load a program from the controller's own store; it is not started."""
        self.loaded_program = name

    def set_watchdog(self, name: str, frequency: float) -> None:
        """Watch that `name` is written at least at `frequency` (Hz); 0 switches it off."""
        self.watchdogs.pop(name, None)
        if frequency > 0.0:
            self.watchdogs[name] = Watchdog(1.0 / frequency, 1.0 / frequency)

    def write_inputs(self, values: dict[str, Any]) -> None:
        """Store the input fields that a client has sent."""
        apply_inputs(self.memory, values)
        for name, (period, _) in self.watchdogs.items():
            if name in values:
                self.watchdogs[name] = Watchdog(period, period)

    # -- modes ----------------------------------------------------------------------------------

    @property
    def can_move(self) -> bool:
        """Whether brakes are released and no stop is active."""
        memory = self.memory
        return memory["robot_mode"] == modes.RUNNING and memory["safety_mode"] in (1, 2)

    def set_runtime(self, state: int) -> None:
        """Set runtime_state and the fields that depend on it."""
        memory = self.memory
        memory["runtime_state"] = state
        bits = 1 if memory["robot_mode"] >= modes.POWER_ON else 0
        memory["robot_status_bits"] = bits | (2 if state == modes.PLAYING else 0)

    def set_robot_mode(self, mode: int) -> None:
        """Set robot_mode and the power bit."""
        self.memory["robot_mode"] = mode
        self.memory["joint_mode"] = (253 if mode == modes.RUNNING else 239,) * 6
        self.set_runtime(self.memory["runtime_state"])

    def pause(self, deceleration: float = DEFAULT_STOP) -> None:
        """Pause the program; the arm brakes (rad/s^2)."""
        if self.program is None or self.memory["runtime_state"] != modes.PLAYING:
            self.motion = Stop(self.target_qd, deceleration)
            return
        self.paused, self.motion = self.motion, Stop(self.target_qd, deceleration)
        self.set_runtime(modes.PAUSED)

    def resume(self) -> None:
        """Go on with a paused program and its motion."""
        self.motion, self.paused = self.paused, HOLD
        self.motion.restart(self.target_q)
        self.set_runtime(modes.PLAYING)

    def set_safety(self, mode: int) -> None:
        """Set safety_mode, safety_status and safety_status_bits together."""
        self.memory["safety_mode"] = self.memory["safety_status"] = mode
        self.memory["safety_status_bits"] = modes.SAFETY_BITS[mode]

    def protective_stop(self) -> None:
        """Stop category 2: the arm brakes, the program pauses."""
        if self.memory["safety_mode"] != modes.SAFETY_NORMAL:
            return
        log.warning("protective stop")
        self.stopped_at = self.clock
        self.set_safety(modes.SAFETY_PROTECTIVE)
        self.pause(2.0 * DEFAULT_STOP)

    def unlock(self) -> None:
        """Clear a protective stop; the program stays paused."""
        if self.memory["safety_mode"] == modes.SAFETY_PROTECTIVE:
            self.set_safety(modes.SAFETY_NORMAL)

    def emergency_stop(self) -> None:
        """Stop: the program ends, power is off."""
        log.warning("emergency stop")
        self.end_program()
        self.motion = Stop(self.target_qd, 2.0 * DEFAULT_STOP)
        self.set_safety(modes.SAFETY_ROBOT_EMERGENCY)
        self.set_robot_mode(modes.POWER_OFF)

    def release_emergency_stop(self) -> None:
        """Release the button: power stays off until it is switched on again."""
        if self.memory["safety_mode"] == modes.SAFETY_ROBOT_EMERGENCY:
            self.set_safety(modes.SAFETY_NORMAL)

    def stall(self, seconds: float) -> None:
        """Send no RTDE packet for `seconds`."""
        self.stall_until = self.clock + seconds

    def freeze(self, frozen: bool) -> None:
        """Stop the timestamp, or let it go on."""
        self.frozen = frozen

    def finite(self, values: Sequence[float], what: str) -> Joints:
        """Return `values` as joints or pose; raises ScriptError if one is not finite."""
        numbers = tuple(float(v) for v in values)
        if not all(map(math.isfinite, numbers)):
            raise ScriptError(f"{what} is not finite: {numbers}")
        return numbers


class ScriptError(Exception):
    """A run-time error of a script: the program stops, as on a real controller."""


def apply_inputs(memory: dict[str, Any], values: dict[str, Any]) -> None:
    """Store a client's input fields, with their effects."""
    memory.update(values)
    for mask, (value, first) in _DIGITAL.items():
        if mask in values:
            _switch(memory, values[mask], values.get(value, 0), first)
    if values.get("speed_slider_mask"):
        fraction = min(max(memory["speed_slider_fraction"], 0.0), 1.0)
        memory["target_speed_fraction"] = memory["speed_scaling"] = fraction
    if "standard_analog_output_mask" in values:
        _set_analog(memory, values)
    for field_name, first in _BIT_FIELDS.items():
        if field_name in values:
            for i in range(32):
                memory[f"input_bit_register_{first + i}"] = bool(values[field_name] >> i & 1)


def _switch(memory: dict[str, Any], mask: int, value: int, first: int) -> None:
    bits = memory["actual_digital_output_bits"]
    memory["actual_digital_output_bits"] = (bits & ~(mask << first)) | ((value & mask) << first)


def _set_analog(memory: dict[str, Any], values: dict[str, Any]) -> None:
    """Set the analog outputs that the mask selects; the others carry rubbish (measured)."""
    mask, kind = values["standard_analog_output_mask"], values["standard_analog_output_type"]
    for i in range(2):
        if mask >> i & 1:
            share = values[f"standard_analog_output_{i}"]
            is_voltage = bool(kind >> i & 1)
            memory[f"standard_analog_output{i}"] = share * (10.0 if is_voltage else 0.020)
