"""The moving commands of ur_rtde's control script. Codes and arguments: measured with 1.6.5."""

from __future__ import annotations

import math
from collections.abc import Callable

from gapbridge.drivers.simulated.plant.kinematics import (
    Joints,
    frame_of,
    solve,
    tcp_in_base,
)
from gapbridge.drivers.simulated.plant.motion import (
    Motion,
    MoveJoints,
    MoveLine,
    Stop,
)
from gapbridge.drivers.simulated.plant.plant_arm import BASE, Frame, place
from gapbridge.drivers.simulated.plant.rotations import Vector3
from gapbridge.drivers.simulated.plant.stream_motion import SpeedJoints, SpeedTool
from gapbridge.drivers.simulated.ur.controller import (
    CYCLE,
    DEFAULT_STOP,
    Controller,
    ScriptError,
    Steps,
)
from gapbridge.drivers.simulated.ur.programs.control_registers import Registers
from gapbridge.drivers.simulated.ur.programs.path_program import path_motion

CONTACT_FORCE = 10.0  # N: force against the motion that counts as contact
JOG_ACCELERATION = 0.5  # m/s^2


def _move(r: Registers, motion: Motion) -> Steps:
    """Run a motion to its end, or concurrently if the client requested that."""
    if r.integer(1) == 1:
        r.start_operation(motion)
        return
    yield from r.controller.run_motion(motion)


def _joint_motion(c: Controller, goal: Joints, speed: float, acceleration: float) -> Motion:
    return MoveJoints(c.target_q, goal, _positive(speed), _positive(acceleration))


def _line_motion(c: Controller, goal: Frame, speed: float, acceleration: float) -> Motion:
    return MoveLine(
        c.plant.arm, c.declared.tool, c.target_q, goal, _positive(speed), _positive(acceleration)
    )


def _positive(value: float) -> float:
    if value <= 0.0:
        raise ScriptError(f"speed and acceleration must be positive, got {value}")
    return value


def _joints_for(c: Controller, goal: Frame) -> Joints:
    joints = solve(c.plant.arm, goal, c.target_q, c.declared.tool)
    if joints is None:
        raise ScriptError("get_inverse_kin: unable to find a solution")
    return joints


def _move_joints_to_pose(r: Registers) -> Steps:
    goal = _joints_for(r.controller, frame_of(r.pose()))
    return _move(r, _joint_motion(r.controller, goal, r.number(6), r.number(7)))


def _move_line_to_joints(r: Registers) -> Steps:
    c = r.controller
    goal = tcp_in_base(c.plant.arm, r.joints(), c.declared.tool)
    return _move(r, _line_motion(c, goal, r.number(6), r.number(7)))


def _servo_line(r: Registers) -> None:
    goal = _joints_for(r.controller, frame_of(r.pose()))
    r.controller.servo(goal, r.number(9))


def _servo_circle(r: Registers) -> None:
    """servoC: taken as a line to the pose, at its speed and acceleration."""
    c = r.controller
    c.start_motion(_line_motion(c, frame_of(r.pose()), r.number(6), r.number(7)))


def _speed_joints(r: Registers) -> None:
    c, goal, acceleration = r.controller, r.joints(), _positive(r.number(6))
    if isinstance(c.motion, SpeedJoints):
        c.motion.aim(goal, acceleration)
    else:
        c.start_motion(SpeedJoints(goal, acceleration))


def _speed_line(r: Registers) -> None:
    c, goal, acceleration = r.controller, r.joints(), _positive(r.number(6))
    if isinstance(c.motion, SpeedTool):
        c.motion.aim(goal, acceleration)
    else:
        c.start_motion(SpeedTool(c.plant.arm, c.declared.tool, goal, acceleration))


def _stop_line(r: Registers) -> Steps:
    """Brake so that the TCP decelerates at the given rate (m/s^2)."""
    c, rate = r.controller, _positive(r.number(0))
    fastest = max(map(abs, c.target_qd))
    speed = sum(v * v for v in c.memory["target_TCP_speed"][:3]) ** 0.5
    duration = max(speed / rate, fastest / 40.0, CYCLE)
    return _move(r, Stop(c.target_qd, max(fastest, 1e-6) / duration))


def _stop_line_now(r: Registers) -> Steps:
    """servoStop, speedStop, stopJog, force mode stop: braking, always to the end."""
    c = r.controller
    return c.run_motion(Stop(c.target_qd, max(_positive(r.number(0)), 1.0)))


def _stop_jog(r: Registers) -> Steps:
    return r.controller.run_motion(Stop(r.controller.target_qd, 2.0))


def _jog(r: Registers) -> None:
    """Jog in base (0), tool (1) or a feature of the client's (2)."""
    c, feature = r.controller, round(r.number(6))
    speed = r.pose()
    turn = BASE
    if feature == 1:
        turn = tcp_in_base(c.plant.arm, c.target_q, c.declared.tool)
    elif feature == 2:
        turn = frame_of(r.pose(8))
    rotation = Frame(turn.rotation, (0.0, 0.0, 0.0))
    shift = place(rotation, Frame(BASE.rotation, speed[:3])).origin
    spin = place(rotation, Frame(BASE.rotation, speed[3:])).origin
    acceleration = r.number(7) or JOG_ACCELERATION
    c.start_motion(SpeedTool(c.plant.arm, c.declared.tool, (*shift, *spin), acceleration))


def _move_path(r: Registers) -> Steps:
    """Run the path that the client wrote into the script."""
    motion = path_motion(r.controller, r.path, r.progress)
    return _move(r, motion)


def _move_until_contact(r: Registers) -> Steps:
    """Move at a tool speed until something pushes back, then stop."""
    c = r.controller
    speed, acceleration = r.pose(), _positive(r.number(12))
    c.start_motion(SpeedTool(c.plant.arm, c.declared.tool, speed, acceleration))
    yield
    while not touches(r):
        yield
    yield from c.run_motion(Stop(c.target_qd, DEFAULT_STOP))


def touches(r: Registers) -> bool:
    """Return whether the surroundings push against the direction of motion, or hard at all."""
    memory = r.controller.memory
    force: Vector3 = memory["actual_TCP_force"][:3]
    speed: Vector3 = memory["target_TCP_speed"][:3]
    pace = math.hypot(*speed)
    if pace > 1e-4:
        against = -sum(f * v for f, v in zip(force, speed, strict=True)) / pace
        return against > CONTACT_FORCE
    return math.hypot(*force) > CONTACT_FORCE


MOTIONS: dict[int, Callable[[Registers], Steps | None]] = {
    1: lambda r: _move(r, _joint_motion(r.controller, r.joints(), r.number(6), r.number(7))),
    2: _move_joints_to_pose,
    3: lambda r: _move(r, _line_motion(r.controller, frame_of(r.pose()), r.number(6), r.number(7))),
    4: _move_line_to_joints,
    7: _stop_jog,
    12: _servo_circle,
    15: _stop_line_now,
    16: _stop_line_now,
    33: _stop_line,
    34: lambda r: _move(r, Stop(r.controller.target_qd, _positive(r.number(0)))),
    41: _jog,
    42: _stop_jog,
    45: _move_path,
    51: _move_until_contact,
}

REALTIME_MOTIONS: dict[int, Callable[[Registers], None]] = {
    9: _speed_joints,
    10: _speed_line,
    11: lambda r: r.controller.servo(r.joints(), r.number(9)),
    24: _servo_line,
}
