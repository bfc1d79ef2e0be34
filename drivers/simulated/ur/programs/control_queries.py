"""The settings and questions of ur_rtde's control script. Codes: measured with 1.6.5."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from gapbridge.drivers.simulated.plant.kinematics import (
    Joints,
    frame_of,
    jacobian,
    pose_of,
    solve,
    tcp_in_base,
    within_limits,
)
from gapbridge.drivers.simulated.plant.plant_arm import place
from gapbridge.drivers.simulated.plant.rotations import Vector3
from gapbridge.drivers.simulated.ur.controller import CYCLE, ScriptError
from gapbridge.drivers.simulated.ur.programs.control_motions import touches
from gapbridge.drivers.simulated.ur.programs.control_registers import Registers

STEADY = 1e-4  # rad/s


def _zero_sensor(r: Registers) -> None:
    r.controller.sensors.zero()


def _cog(r: Registers) -> Vector3:
    """Return the centre of gravity argument; all zero keeps the present one, as the script does."""
    cog = (r.number(1), r.number(2), r.number(3))
    return cog if any(cog) else r.controller.declared.payload_cog


def _set_payload(r: Registers) -> None:
    r.controller.declared.set_payload(r.number(0), _cog(r))


def _set_target_payload(r: Registers) -> None:
    _set_payload(r)
    r.controller.declared.set_payload_inertia(r.pose(4))


def _set_tcp(r: Registers) -> None:
    r.controller.declared.set_tcp(r.pose())


def _set_gravity(r: Registers) -> None:
    r.controller.declared.set_gravity(r.pose()[:3])


def _protective_stop(r: Registers) -> None:
    r.controller.protective_stop()


def _set_watchdog(r: Registers) -> None:
    r.controller.set_watchdog(r.watched, r.number(0))


def _solution(r: Registers, near: Joints) -> Joints | None:
    c = r.controller
    return solve(c.plant.arm, frame_of(r.pose()), near, c.declared.tool)


def _answer_solution(r: Registers, found: Joints | None) -> None:
    if found is None:
        raise ScriptError("get_inverse_kin: unable to find a solution")
    r.answer_vector(found)


def _inverse(r: Registers) -> None:
    _answer_solution(r, _solution(r, r.controller.plant.q))


def _inverse_near(r: Registers) -> None:
    _answer_solution(r, _solution(r, r.joints(6)))


def _has_solution(r: Registers) -> None:
    r.answer(int(_solution(r, r.controller.plant.q) is not None))


def _has_solution_near(r: Registers) -> None:
    r.answer(int(_solution(r, r.joints(6)) is not None))


def _forward(r: Registers) -> None:
    c = r.controller
    r.answer_vector(pose_of(tcp_in_base(c.plant.arm, c.plant.q, c.declared.tool)))


def _forward_of(r: Registers) -> None:
    frame = tcp_in_base(r.controller.plant.arm, r.joints(), frame_of(r.pose(6)))
    r.answer_vector(pose_of(frame))


def _flange_pose(r: Registers) -> None:
    arm = r.controller.plant.arm
    r.answer_vector(pose_of(arm.flange(r.controller.plant.q)))


def _pose_trans(r: Registers) -> None:
    r.answer_vector(pose_of(place(frame_of(r.pose()), frame_of(r.pose(6)))))


def _tcp_offset(r: Registers) -> None:
    r.answer_vector(r.controller.declared.tcp)


def _target_waypoint(r: Registers) -> None:
    r.answer_vector(r.controller.memory["target_TCP_pose"])


def _pose_is_safe(r: Registers) -> None:
    found = _solution(r, r.controller.target_q)
    arm = r.controller.plant.arm
    r.answer(int(found is not None and within_limits(arm, found)))


def _joints_are_safe(r: Registers) -> None:
    r.answer(int(within_limits(r.controller.plant.arm, r.joints())))


def _is_steady(r: Registers) -> None:
    r.answer(int(max(map(abs, r.controller.plant.qd)) < STEADY))


def _joint_torques(r: Registers) -> None:
    r.answer_vector(r.controller.memory["actual_current_as_torque"])


def _step_time(r: Registers) -> None:
    r.answer_vector((CYCLE,))


def _joint_history(r: Registers) -> None:
    """Answer joint positions of some cycles ago, as far back as the present speed says."""
    q, qd, back = r.controller.plant.q, r.controller.plant.qd, max(r.integer(1), 0) * CYCLE
    r.answer_vector([a - v * back for a, v in zip(q, qd, strict=True)])


def _tool_contact(r: Registers) -> None:
    r.answer(int(touches(r)))


def _joint_accelerations(r: Registers) -> None:
    r.answer_vector(r.controller.memory["target_qdd"])


def _jacobian(r: Registers) -> None:
    """Answer the first column only: later controllers spread all 36 over other registers."""
    c = r.controller
    J = jacobian(c.plant.arm, c.plant.q, c.declared.tool)
    r.answer_vector([float(v) for v in np.ravel(J, order="F")[:6]])


def _free_drive_status(r: Registers) -> None:
    r.answer(0 if math.isfinite(r.controller.clock) else 3)


def _nothing(r: Registers) -> None:
    """Accept without an effect on this plant: teach mode, damping, gains, force mode."""


QUERIES: dict[int, Callable[[Registers], None]] = {
    8: _zero_sensor,
    17: _set_payload,
    18: _nothing,  # teach mode
    19: _nothing,  # end of teach mode
    20: _nothing,  # force mode damping
    21: _nothing,  # force mode gain
    28: _target_waypoint,
    29: _set_tcp,
    30: _inverse_near,
    31: _protective_stop,
    35: _set_watchdog,
    36: _pose_is_safe,
    37: _joints_are_safe,
    39: _pose_trans,
    40: _tcp_offset,
    43: _forward,
    44: _forward_of,
    46: _inverse,
    47: _is_steady,
    52: _nothing,  # freedrive
    53: _nothing,  # end of freedrive
    54: _free_drive_status,
    56: _nothing,  # external sensor over RTDE
    57: _nothing,  # external sensor
    59: _set_gravity,
    60: _has_solution,
    61: _has_solution_near,
    62: _nothing,  # contact detection starts
    63: _tool_contact,
    64: _tool_contact,
    65: _set_target_payload,
}

REALTIME_QUERIES: dict[int, Callable[[Registers], None]] = {
    6: _nothing,  # force mode: the plant has no force control
    25: _tool_contact,
    26: _step_time,
    27: _joint_history,
    38: _joint_torques,
    58: _flange_pose,
    66: _nothing,  # direct torque: the plant is position controlled
    67: _nothing,  # mass matrix, not on this version
    68: _nothing,  # Coriolis torques, not on this version
    69: _joint_accelerations,
    70: _jacobian,
    71: _nothing,  # Jacobian's time derivative, not on this version
}
