"""Models of an arm in simulators' formats, written from its DH frames; other frames than ours."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gapbridge.core.arm import Arm

UR_JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint",
             "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")  # fmt: skip
BASE_TURN = Rotation.from_euler("z", 2.0)  # the model stands turned, and beside the origin
BASE_AT = np.array([0.3, -0.2, 0.5])


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{v:.17g}" for v in values)


def frame_turns(n: int) -> list[Rotation]:
    """Return how each body's frame is turned against the joint's frame: any, but known."""
    return [Rotation.from_rotvec([0.2 * i, -0.3, 0.1 * i]) for i in range(n + 1)]


def mjcf(arm: Arm, names: tuple[str, ...], kp: float = 0.0, tcp: float = 0.1,
         load: float = 0.0) -> str:  # fmt: skip
    """Return an MJCF model with body frames that are not the joints' frames."""
    turns = frame_turns(arm.n)
    step = Rotation.from_matrix(arm.link_in_link[0][:3, :3])
    at, turn = BASE_AT + BASE_TURN.apply(arm.link_in_link[0][:3, 3]), BASE_TURN * step
    opened, text = "", ""
    for i, name in enumerate(names):
        quat = (turn * turns[i]).as_quat()[[3, 0, 1, 2]]
        axis = turns[i].inv().apply([0, 0, 1])
        cog = turns[i].inv().apply(arm.cog[i])
        text += (
            f'<body name="link_{i + 1}" pos="{numbers(at)}" quat="{numbers(quat)}">'
            f'<inertial pos="{numbers(cog)}" mass="{max(arm.mass[i], 1e-3):.17g}" '
            f'diaginertia="1e-3 1e-3 1e-3"/>'
            f'<joint name="{name}" axis="{numbers(axis)}" armature="{0.5 if kp else 0}"/>'
        )
        opened += "</body>"
        nxt = arm.link_in_link[i + 1]
        at = turns[i].inv().apply(nxt[:3, 3])
        turn = turns[i].inv() * Rotation.from_matrix(nxt[:3, :3])
    flange = turn.as_quat()[[3, 0, 1, 2]]
    along = at + turn.apply([0, 0, tcp])
    text += f'<site name="tcp" pos="{numbers(along)}" quat="{numbers(flange)}"/>'
    if load:
        text += (
            f'<body name="load" pos="{numbers(along)}"><inertial pos="0 0 0" mass="{load}" '
            'diaginertia="1e-4 1e-4 1e-4"/></body>'
        )
    drives = "".join(
        f'<position name="drive_{name}" joint="{name}" kp="{kp}" dampratio="1"/>' for name in names
    )
    return (
        '<mujoco model="arm"><compiler angle="radian"/>'
        '<option timestep="0.001" integrator="implicitfast"/>'
        f"<worldbody>{text}{opened}</worldbody>"
        f"<actuator>{drives if kp else ''}</actuator>"
        f'<keyframe><key name="home" qpos="{numbers(0.1 * np.arange(arm.n))}"/></keyframe></mujoco>'
    )


def urdf(arm: Arm, names: tuple[str, ...], tcp: float = 0.1) -> str:
    """Return a URDF whose link frames are not the joints' DH frames, with comments in it."""
    turns = frame_turns(arm.n)
    turn = Rotation.from_matrix(arm.link_in_link[0][:3, :3])
    at = arm.link_in_link[0][:3, 3]
    text = '<robot name="arm">\n  <!-- kept -->\n  <link name="base_link"/>\n'
    parent = "base_link"
    for i, name in enumerate(names):
        rpy = (turn * turns[i]).as_euler("xyz")
        axis = turns[i].inv().apply([0, 0, 1])
        text += (
            f'  <joint name="{name}" type="revolute">\n    <!-- origin xyz="9 9 9" -->\n'
            f'    <origin rpy="{numbers(rpy)}" xyz="{numbers(at)}"/>\n'
            f'    <parent link="{parent}"/><child link="link_{i + 1}"/>\n'
            f'    <axis xyz="{numbers(axis)}"/>\n'
            f'    <limit lower="-6.3" upper="6.3" effort="100" velocity="3"/>\n  </joint>\n'
            f'  <link name="link_{i + 1}">\n    <inertial><origin xyz="0 0 0"/>'
            f'<mass value="{max(arm.mass[i], 1e-3):.17g}"/><inertia ixx="0.1" ixy="0" ixz="0" '
            f'iyy="0.1" iyz="0" izz="0.1"/></inertial>\n  </link>\n'
        )
        parent = f"link_{i + 1}"
        nxt = arm.link_in_link[i + 1]
        at = turns[i].inv().apply(nxt[:3, 3])
        turn = turns[i].inv() * Rotation.from_matrix(nxt[:3, :3])
    at = at + turn.apply([0, 0, tcp])
    text += (
        f'  <joint name="tool_joint" type="fixed">\n'
        f'    <origin xyz="{numbers(at)}" rpy="{numbers(turn.as_euler("xyz"))}"/>\n'
        f'    <parent link="{parent}"/><child link="tool"/>\n  </joint>\n  <link name="tool"/>\n'
        f'  <transmission name="t"><joint name="{names[0]}"><x/></joint></transmission>\n'
    )
    return text + "</robot>\n"
