"""The protocol-independent part of a simulated controller: plant, clock, sensors, own motion.

An ArmController has no protocol. Protocol servers read its state and command it;
``protocol_server.py`` runs them.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from gapbridge.drivers.simulated.plant.declared_settings import DeclaredSettings
from gapbridge.drivers.simulated.plant.kinematics import Joints, within_limits
from gapbridge.drivers.simulated.plant.motion import Hold, Motion, MoveJoints, Stop
from gapbridge.drivers.simulated.plant.plant import Plant
from gapbridge.drivers.simulated.plant.plant_arm import PlantArm
from gapbridge.drivers.simulated.plant.plant_settings import PlantSettings
from gapbridge.drivers.simulated.plant.sensors import Sensors
from gapbridge.drivers.simulated.server.bench import BenchError

log = logging.getLogger("drivers.simulated")

OWN_SPEED, OWN_ACCELERATION = 0.5, 1.0  # rad/s, rad/s^2: the robot's own program
BRAKING = 24.0  # rad/s^2, of a stop
HOLD = Hold()


class ArmController:
    """A controller without a protocol, for an arm of any number of joints.

    The robot's own program moves ``own_q`` (the bench's ``move``); ``command`` takes the arm over;
    ``offset_by`` adds offsets to that motion. A stop brakes the arm and refuses commands
    until it is released.
    """

    def __init__(self, plant: Plant, declared: DeclaredSettings, cycle: float) -> None:
        self.plant, self.declared = plant, declared
        self.period = cycle  # s
        self.clock = 0.0  # s, the controller's clock; stops when frozen
        self.running = 0.0  # s since the start; never stops
        self.frozen = False
        self.protective = False  # a protective stop is active
        self.emergency = False  # the button is pressed
        self.largest_servo_step = 0.0  # rad, between two commands
        self.target_q: Joints = plant.q
        self.target_qd: Joints = (0.0,) * len(plant.q)
        self.own_q: Joints = plant.q  # rad, target of the robot's own program
        self.motion: Motion = HOLD  # of the robot's own program
        self.joint_offset: Joints = (0.0,) * len(plant.q)
        self.commanded = False  # a client moves the arm, not the robot's own program
        self._goal: Joints = plant.q
        self._stall_until = 0.0
        self.memory: dict[str, Any] = {"timestamp": 0.0}
        self.sensors = Sensors(plant, declared, self.memory)
        self.sensors.update(self.target_q, cycle)

    # -- readings ---------------------------------------------------------------------------------

    @property
    def n(self) -> int:
        """Joints."""
        return len(self.plant.q)

    @property
    def q(self) -> Joints:
        """Joint encoders (n,), rad."""
        return self.plant.q

    @property
    def qd(self) -> Joints:
        """Joint velocities (n,), rad/s."""
        return self.plant.qd

    @property
    def temperatures(self) -> Joints:
        """Joint temperatures (n,), °C."""
        return tuple(self.memory["joint_temperatures"])

    @property
    def joint_torque(self) -> Joints:
        """Measured joint torques (n,), Nm."""
        return tuple(self.memory["actual_current_as_torque"])

    @property
    def tcp_force(self) -> Joints:
        """What the surroundings apply to the tool (6,), at the TCP, base axes, N and Nm."""
        return tuple(self.memory["actual_TCP_force"])

    @property
    def raw_wrench(self) -> Joints:
        """The flange sensor (6,), flange axes, payload included, N and Nm."""
        return tuple(self.memory["ft_raw_wrench"])

    @property
    def can_move(self) -> bool:
        """Whether no stop is active."""
        return not (self.protective or self.emergency)

    @property
    def stalled(self) -> bool:
        """Whether the controller sends and answers nothing now."""
        return self.running < self._stall_until

    # -- commands ---------------------------------------------------------------------------------

    def command(self, q: Sequence[float]) -> None:
        """Let the plant follow joints `q` (n, rad) from now on; ends the robot's own motion.

        Joints outside the limits, or not finite, are a protective stop; a stop ignores commands.
        """
        goal = tuple(float(v) for v in q)
        if not self.can_move:
            return
        if len(goal) != self.n or not within_limits(self.plant.arm, goal):
            log.warning("joint command %s is outside the joint limits", goal)
            self.protective_stop()
            return
        if self.commanded:
            step = max(abs(a - b) for a, b in zip(goal, self._goal, strict=True))
            self.largest_servo_step = max(self.largest_servo_step, step)
        self.commanded, self.motion = True, HOLD
        self._goal = goal

    def offset_by(self, joint_offset: Sequence[float]) -> None:
        """Add joint offsets (n, rad) to the robot's own motion."""
        self.joint_offset = tuple(float(v) for v in joint_offset)

    def let_go(self) -> None:
        """Return control to the robot's own program, which holds the present joints."""
        self.commanded = False
        self.own_q = self.target_q
        self.joint_offset = (0.0,) * self.n

    def move_own(self, goal: Joints) -> None:
        """Let the robot's own program move to `goal` (n, rad). Raises BenchError."""
        if not self.can_move:
            raise BenchError("move: the robot is not running")
        if not within_limits(self.plant.arm, goal):
            raise BenchError("move: outside the joint limits")
        if self.commanded:
            self.let_go()
        self.motion = MoveJoints(self.own_q, goal, OWN_SPEED, OWN_ACCELERATION)

    def stop_own(self) -> None:
        """Brake the motion of the robot's own program."""
        self.motion = Stop(self.target_qd, BRAKING)

    # -- stops ------------------------------------------------------------------------------------

    def protective_stop(self) -> None:
        """Brake and stay until ``unlock``."""
        self.protective = True
        self._brake()

    def unlock(self) -> None:
        """Release a protective stop."""
        self.protective = False

    def emergency_stop(self) -> None:
        """Brake and stay until the button is released."""
        self.emergency = True
        self._brake()

    def release_emergency_stop(self) -> None:
        """Release the button."""
        self.emergency = False

    def _brake(self) -> None:
        self.let_go()
        self.stop_own()

    def freeze(self, frozen: bool) -> None:
        """Stop the clock, or let it go on."""
        self.frozen = frozen

    def stall(self, seconds: float) -> None:
        """Send and answer nothing for a while."""
        self._stall_until = self.running + seconds

    # -- the cycle --------------------------------------------------------------------------------

    def cycle(self) -> None:
        """Advance clock, own motion, plant and sensors by one period."""
        dt = self.period
        self.running += dt
        if not self.frozen:
            self.clock += dt
            self.memory["timestamp"] = self.clock
        before = self.target_q
        if self.commanded:
            self.target_q = self._goal
        else:
            self._follow_own(dt)
        self.target_qd = tuple((b - a) / dt for a, b in zip(before, self.target_q, strict=True))
        self.plant.step(self.target_q, dt)
        self.sensors.update(self.target_q, dt)

    def _follow_own(self, dt: float) -> None:
        """Advance the robot's own program, with the offsets added."""
        self.own_q = self.motion.step(self.own_q, self.target_qd, dt)
        if self.motion.done:
            self.motion = HOLD
        wanted = tuple(a + b for a, b in zip(self.own_q, self.joint_offset, strict=True))
        if within_limits(self.plant.arm, wanted):
            self.target_q = self._goal = wanted
        elif self.can_move:
            log.warning("joint target %s is outside the joint limits", wanted)
            self.protective_stop()


def make_controller(
    arm: PlantArm,
    plant: PlantSettings,
    start_q: Sequence[float],
    period: float,
    declare: bool = True,
) -> ArmController:
    """Return a controller whose arm rests at `start_q` (n, rad) that is cycled every `period` s.

    With `declare` the controller is given the plant's true TCP and payload.
    """
    declared = DeclaredSettings()
    if declare:
        declared.set_tcp(plant.tcp)
        declared.set_payload(plant.payload_mass, plant.payload_cog)
    return ArmController(Plant(arm, plant, start_q), declared, period)
