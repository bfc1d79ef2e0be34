"""Pinocchio as a second opinion on rigid arms: frames, Jacobians, moments."""

from __future__ import annotations

import numpy as np
import pinocchio as pin


def from_dh(dh: list[dict]) -> pin.Model:
    """Return the arm of standard DH rows (offsets folded in), flange as frame "flange"."""
    model = pin.Model()
    before, parent = pin.SE3.Identity(), 0
    for i, row in enumerate(dh):
        parent = model.addJoint(
            parent, pin.JointModelRZ(),
            before * pin.SE3(pin.exp3(np.array([0, 0, row.get("offset", 0.0)])), np.zeros(3)),
            f"j{i + 1}",
        )  # fmt: skip
        turn = pin.exp3(np.array([row["alpha"], 0, 0]))
        before = pin.SE3(turn, np.array([row["a"], 0, row["d"]]))
        centre = before.act(np.asarray(row.get("cog", np.zeros(3)), float))
        model.appendBodyToJoint(
            parent, pin.Inertia(row.get("mass", 0.0), centre, np.zeros((3, 3))), pin.SE3.Identity()
        )
    model.addFrame(pin.Frame("flange", parent, before, pin.FrameType.OP_FRAME))
    return model


def flange_pose(model: pin.Model, q: np.ndarray, frame: str = "flange") -> pin.SE3:
    """Return where the flange stands."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(frame)]


def tool_jacobian(model: pin.Model, q: np.ndarray, tcp: np.ndarray, frame: str = "flange"):
    """Return the TCP's Jacobian (6, n), base axes; ``tcp`` (3,) in the flange."""
    data = model.createData()
    with_tool = model.copy()
    old = model.frames[model.getFrameId(frame)]
    place = old.placement * pin.SE3(np.eye(3), tcp)
    index = with_tool.addFrame(pin.Frame("tcp", old.parentJoint, place, pin.FrameType.OP_FRAME))
    data = with_tool.createData()
    pin.computeJointJacobians(with_tool, data, q)
    pin.framesForwardKinematics(with_tool, data, q)
    return pin.getFrameJacobian(with_tool, data, index, pin.LOCAL_WORLD_ALIGNED)


def joint_moments(
    model: pin.Model, q: np.ndarray, gravity: np.ndarray, tcp: np.ndarray, wrench: np.ndarray,
    payload: float, payload_cog: np.ndarray, frame: str = "flange",
) -> np.ndarray:  # fmt: skip
    """Return the moment (n, 3) of everything beyond each joint about its origin, base axes."""
    own = model.copy()
    own.gravity.linear = gravity
    flange = own.frames[own.getFrameId(frame)]
    carried = flange.placement.act(payload_cog)
    own.appendBodyToJoint(
        flange.parentJoint, pin.Inertia(payload, carried, np.zeros((3, 3))), pin.SE3.Identity()
    )
    data = own.createData()
    pin.forwardKinematics(own, data, q)
    outside = [pin.Force.Zero() for _ in range(own.njoints)]
    last = data.oMi[flange.parentJoint]
    R, arm = last.rotation, flange.placement.act(tcp)
    f = R.T @ wrench[:3]
    outside[flange.parentJoint] = pin.Force(f, R.T @ wrench[3:] + np.cross(arm, f))
    zero = np.zeros(own.nv)
    pin.rnea(own, data, q, zero, zero, outside)
    # data.f is what each joint passes on to hold its link up: the opposite of the load
    return np.array([-data.oMi[i].rotation @ data.f[i].angular for i in range(1, own.njoints)])
