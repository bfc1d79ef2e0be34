"""The effects that an MJCF can hold, each put into a MuJoCo model by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.patch.arms import Soft, WrittenArm
from benchmarks.patch.simulated import Servo

KP, KV = 4e4, 1200.0  # Nm/rad and Nm s/rad of every position servo
GIVING = [0.9, 0.95, 1e-3, 0.5, 2.0]  # MuJoCo's own solimp
STIFF = [0.999, 0.9999, 1e-4, 0.5, 2.0]  # for an arm straight up at zero, by which it is scaled
STATIC, APPROACHED, WRENCH, DROOP = "poses", "poses from both sides", "wrench", "servo"
MOVING, TORQUE = "motion", "torque"


@dataclass(frozen=True)
class Case:
    """One effect as it is put into the real arm; ``value`` is what should be found."""

    effect: str
    kind: str
    joint: int | None  # from 1
    value: float
    parameter: str = ""  # whose value that is; '': the effect's only one
    put: Callable[[Any, WrittenArm], None] | None = None
    soft: Soft = field(default_factory=Soft)
    servo: Servo = field(default_factory=Servo)
    heavier: float = 0.0  # kg
    shifted: float = 0.0  # m along x of the flange
    stiffening: tuple[float, float] | None = None  # c, M0

    @property
    def channel(self) -> str:
        """Return the channel in which it is looked for."""
        return {STATIC: "position", APPROACHED: "position", WRENCH: "wrench", DROOP: "tracking",
                MOVING: "tracking", TORQUE: "torque"}[self.kind]  # fmt: skip

    @property
    def name(self) -> str:
        """Return the parameter's name as it is reported."""
        parts = [self.effect, self.joint, self.parameter]
        return "_".join(str(p) for p in parts if p not in (None, ""))


def _joint(spec: Any, arm: WrittenArm, joint: int) -> Any:
    return spec.joint(arm.joints[joint - 1])


def _spring(spec: Any, arm: WrittenArm, joint: int, c: float, turn: Rotation, name: str) -> None:
    """Put a spring of 1/c behind a joint, about its axis turned by ``turn`` in its own frame."""
    from benchmarks.patch.arms import frame_turns

    axis = frame_turns(arm.n)[joint - 1].inv().apply(turn.apply([0, 0, 1]))
    k = 1 / c
    spec.body(f"link_{joint}").add_joint(
        name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, stiffness=[k, 0, 0],
        damping=[max(500.0, 0.05 * k), 0, 0], armature=1e-3,
    )  # fmt: skip


def _zero(joint: int, angle: float) -> Callable[[Any, WrittenArm], None]:
    def put(spec: Any, arm: WrittenArm) -> None:
        body = spec.body(f"link_{joint}")
        own = Rotation.from_quat(np.roll(body.quat, -1))
        turned = own * Rotation.from_rotvec(angle * np.array(_joint(spec, arm, joint).axis))
        body.quat = np.roll(turned.as_quat(), 1)

    return put


def _longer(joint: int, shift: float) -> Callable[[Any, WrittenArm], None]:
    def put(spec: Any, arm: WrittenArm) -> None:
        body = spec.body(f"link_{joint + 1}")
        along = np.array(body.pos)
        body.pos = along * (1 + shift / np.linalg.norm(along))

    return put


def _tool(spec: Any, arm: WrittenArm) -> None:
    spec.site("tcp").pos = np.add(spec.site("tcp").pos, [1.2e-3, 0, 0])


def _axial(joint: int, c: float) -> Callable[[Any, WrittenArm], None]:
    return lambda spec, arm: _spring(spec, arm, joint, c, Rotation.identity(), "soft")


def _radial(joint: int, c: float) -> Callable[[Any, WrittenArm], None]:
    def put(spec: Any, arm: WrittenArm) -> None:
        _spring(spec, arm, joint, c, Rotation.from_euler("y", np.pi / 2), "soft_x")
        _spring(spec, arm, joint, c, Rotation.from_euler("x", -np.pi / 2), "soft_y")

    return put


def _tilted(tilt: float) -> Callable[[Any, WrittenArm], None]:
    """Turn gravity about x of base, over two soft joints."""
    from benchmarks.patch.arms import BASE_TURN

    def put(spec: Any, arm: WrittenArm) -> None:
        _spring(spec, arm, 2, 2e-5, Rotation.identity(), "soft_2")
        _spring(spec, arm, 3 if arm.n == 6 else 4, 3e-5, Rotation.identity(), "soft_next")
        in_base = Rotation.from_rotvec([tilt, 0, 0]).apply([0, 0, -9.80665])
        spec.option.gravity = BASE_TURN.apply(in_base)

    return put


def _play(joint: int, play: float) -> Callable[[Any, WrittenArm], None]:
    def put(spec: Any, arm: WrittenArm) -> None:
        own = _joint(spec, arm, joint)
        contact = GIVING if arm.n == 6 else STIFF
        spec.body(f"link_{joint}").add_joint(
            name="play", type=mujoco.mjtJoint.mjJNT_HINGE, axis=np.array(own.axis), limited=1,
            range=[-play / 2, play / 2], armature=1e-2, solref_limit=[0.003, 1.0],
            solimp_limit=contact,
        )  # fmt: skip
        rubbing = spec.add_tendon(name="rubbing", frictionloss=4.0, solimp_friction=contact)
        rubbing.wrap_joint(own.name, 1.0)
        rubbing.wrap_joint("play", 1.0)

    return put


def _of_joint(joint: int, field_: str, value: float) -> Callable[[Any, WrittenArm], None]:
    def put(spec: Any, arm: WrittenArm) -> None:
        own = _joint(spec, arm, joint)
        if field_ == "damping":
            own.damping = [value, 0, 0]
        else:
            setattr(own, field_, getattr(own, field_) + value)

    return put


def _droop(joint: int, c: float) -> Callable[[Any, WrittenArm], None]:
    def put(spec: Any, arm: WrittenArm) -> None:
        drive = spec.actuator(f"drive_{arm.joints[joint - 1]}")
        kp = 1 / (1 / KP + c)
        gain, bias = np.array(drive.gainprm), np.array(drive.biasprm)
        gain[0], bias[1] = kp, -kp
        drive.gainprm, drive.biasprm = gain, bias

    return put


def _heavier_link(joint: int, share: float) -> Callable[[Any, WrittenArm], None]:
    def put(spec: Any, arm: WrittenArm) -> None:
        body = spec.body(f"link_{joint}")
        body.mass *= 1 + share
        body.inertia = np.array(body.inertia) * (1 + share)

    return put


def _shifted_link(joint: int, moment: float) -> Callable[[Any, WrittenArm], None]:
    """Shift a link's centre of gravity along x of the axes in which the cell gives it."""
    from benchmarks.patch.arms import frame_turns

    def put(spec: Any, arm: WrittenArm) -> None:
        body = spec.body(f"link_{joint}")
        axes = arm.arm.body_axes
        along = np.array([1.0, 0, 0]) if axes is None else axes[joint - 1] @ [1.0, 0, 0]
        in_body = frame_turns(arm.n)[joint - 1].inv().apply(along)
        body.ipos = np.array(body.ipos) + in_body * moment / body.mass

    return put


def _turned_sensor(spec: Any, arm: WrittenArm) -> None:
    spec.site("ft").quat = np.roll(Rotation.from_rotvec([0.03, 0, 0]).as_quat(), 1)


def cases(arm: WrittenArm) -> tuple[Case, ...]:
    """Return the cases of an arm: the elbow is joint 3 of six, joint 4 of seven."""
    elbow = 3 if arm.n == 6 else 4
    link = 3  # the one that grows and bends
    tilt = 0.05 if arm.n == 6 else 0.15  # the small arm's 0.05 shows as 0.02 mm, as its noise
    flexible = Soft(link=2 if arm.n == 6 else 3, flexibility=2e-5)
    return (
        Case("joint_offset", STATIC, elbow, 3e-3, put=_zero(elbow, 3e-3)),
        Case("link_geometry", STATIC, link, -1.5e-3 if arm.n == 6 else 1.5e-3,
             "a" if arm.n == 6 else "d",
             put=_longer(link, 1.5e-3)),
        Case("tool_frame", STATIC, None, 1.2e-3, "x", put=_tool),
        Case("axial_compliance", STATIC, 2, 2.5e-5, put=_axial(2, 2.5e-5)),
        # that of joint 1 is the same motion as the compliance of the base
        Case("radial_compliance", STATIC, 2, 2e-5, put=_radial(2, 2e-5)),
        Case("stiffness_nonlinearity", STATIC, 2, 4e-5, "compliance",
             stiffening=(4e-5, 500.0 if arm.n == 6 else 175.0)),
        Case("link_flexibility", STATIC, flexible.link, flexible.flexibility, soft=flexible),
        Case("base_compliance", STATIC, None, 1.5e-5, "x", soft=Soft((1.5e-5, 2.5e-5))),
        Case("gravity_direction", STATIC, None, tilt, "x", put=_tilted(tilt)),
        Case("backlash", APPROACHED, 1, 2e-3, put=_play(1, 2e-3)),
        Case("payload", WRENCH, None, 0.8, heavier=0.8),
        Case("payload_cog", WRENCH, None, 0.02, "x", shifted=0.02),
        Case("ft_misalignment", WRENCH, None, 0.03, "rx", put=_turned_sensor),
        Case("latency", MOVING, 3, 0.02, servo=Servo(2, delay=0.02)),
        Case("tracking_lag", MOVING, 3, 0.04, servo=Servo(2, lag=0.0405)),
        Case("servo_droop", DROOP, 2, 3e-5, put=_droop(2, 3e-5)),
        Case("coulomb_friction", TORQUE, 2, 6.0, put=_of_joint(2, "frictionloss", 6.0)),
        Case("viscous_friction", TORQUE, elbow, 12.0, put=_of_joint(elbow, "damping", 12.0)),
        Case("rotor_inertia", TORQUE, 3, 2.5, put=_of_joint(3, "armature", 2.5)),
        Case("link_inertia", TORQUE, 3, 0.25, put=_heavier_link(3, 0.25)),
        Case("link_cog", TORQUE, 2, 0.4, "x", put=_shifted_link(2, 0.4)),
    )  # fmt: skip
