"""The settings and questions of ur_rtde's control script. Codes: measured with 1.6.5."""

from __future__ import annotations

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


def _cog(r: Registers) -> Vector3:
    """Return the centre of gravity argument; all zero keeps the present one, as the script does."""
    cog = (r.number(1), r.number(2), r.number(3))
    return cog if any(cog) else r.controller.declared.payload_cog


def _set_target_payload(r: Registers) -> None:
    r.controller.declared.set_payload(r.number(0), _cog(r))
    r.controller.declared.set_payload_inertia(r.pose(4))


def _solution(r: Registers, near: Joints) -> Joints | None:
    c = r.controller
    return solve(c.plant.arm, frame_of(r.pose()), near, c.declared.tool)


def _answer_solution(r: Registers, joints: Joints | None) -> None:
    if joints is None:
        raise ScriptError("get_inverse_kin: unable to find a solution")
    r.answer_vector(joints)


def _pose_is_safe(r: Registers) -> None:
    joints = _solution(r, r.controller.target_q)
    arm = r.controller.plant.arm
    r.answer(int(joints is not None and within_limits(arm, joints)))


def _forward(r: Registers) -> None:
    c = r.controller
    r.answer_vector(pose_of(tcp_in_base(c.plant.arm, c.plant.q, c.declared.tool)))


def _forward_of(r: Registers) -> None:
    frame = tcp_in_base(r.controller.plant.arm, r.joints(), frame_of(r.pose(6)))
    r.answer_vector(pose_of(frame))


def _joint_history(r: Registers) -> None:
    """Answer joint positions of some cycles ago, as far back as the present speed says."""
    q, qd, back = r.controller.plant.q, r.controller.plant.qd, max(r.integer(1), 0) * CYCLE
    r.answer_vector([a - v * back for a, v in zip(q, qd, strict=True)])


def _tool_contact(r: Registers) -> None:
    r.answer(int(touches(r)))


def _jacobian(r: Registers) -> None:
    """Answer the first column only: later controllers spread all 36 over other registers."""
    c = r.controller
    J = jacobian(c.plant.arm, c.plant.q, c.declared.tool)
    r.answer_vector([float(v) for v in np.ravel(J, order="F")[:6]])


def _nothing(r: Registers) -> None:
    """Accept without an effect on this plant: teach mode, damping, gains, force mode."""


QUERIES: dict[int, Callable[[Registers], None]] = {
    8: lambda r: r.controller.sensors.zero(),
    17: lambda r: r.controller.declared.set_payload(r.number(0), _cog(r)),
    28: lambda r: r.answer_vector(r.controller.memory["target_TCP_pose"]),
    29: lambda r: r.controller.declared.set_tcp(r.pose()),
    30: lambda r: _answer_solution(r, _solution(r, r.joints(6))),
    31: lambda r: r.controller.protective_stop(),
    35: lambda r: r.controller.set_watchdog(r.watched, r.number(0)),
    36: _pose_is_safe,
    37: lambda r: r.answer(int(within_limits(r.controller.plant.arm, r.joints()))),
    39: lambda r: r.answer_vector(pose_of(place(frame_of(r.pose()), frame_of(r.pose(6))))),
    40: lambda r: r.answer_vector(r.controller.declared.tcp),
    43: _forward,
    44: _forward_of,
    46: lambda r: _answer_solution(r, _solution(r, r.controller.plant.q)),
    47: lambda r: r.answer(int(max(map(abs, r.controller.plant.qd)) < STEADY)),
    54: lambda r: r.answer(0),  # freedrive is possible
    59: lambda r: r.controller.declared.set_gravity(r.pose()[:3]),
    60: lambda r: r.answer(int(_solution(r, r.controller.plant.q) is not None)),
    61: lambda r: r.answer(int(_solution(r, r.joints(6)) is not None)),
    63: _tool_contact,
    64: _tool_contact,
    65: _set_target_payload,
    # teach mode, force mode's damping and gain, freedrive, external sensors, contact detection
    **dict.fromkeys((18, 19, 20, 21, 52, 53, 56, 57, 62), _nothing),
}

REALTIME_QUERIES: dict[int, Callable[[Registers], None]] = {
    25: _tool_contact,
    26: lambda r: r.answer_vector((CYCLE,)),
    27: _joint_history,
    38: lambda r: r.answer_vector(r.controller.memory["actual_current_as_torque"]),
    58: lambda r: r.answer_vector(pose_of(r.controller.plant.arm.flange(r.controller.plant.q))),
    69: lambda r: r.answer_vector(r.controller.memory["target_qdd"]),
    70: _jacobian,
    # force mode and direct torque, which this plant has not; mass matrix, Coriolis torques and the
    # Jacobian's time derivative, which this version has not
    **dict.fromkeys((6, 66, 67, 68, 71), _nothing),
}
