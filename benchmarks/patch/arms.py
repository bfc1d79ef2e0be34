"""Models of an arm in simulators' formats, written from its DH frames; other frames than ours."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from gapbridge.core.arm import Arm, arm_from_dh, builtin_arm
from gapbridge.core.rotation import transform

UR_JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint",
             "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")  # fmt: skip
BASE_TURN = Rotation.from_euler("z", 2.0)  # the model stands turned, and beside the origin
BASE_AT = np.array([0.3, -0.2, 0.5])


SEVEN = tuple(  # a seven-joint arm: d, alpha, mass
    {"a": 0.0, "alpha": sign * np.pi / 2, "d": d, "mass": mass, "cog": list(cog)}
    for sign, d, mass, cog in (
        (-1, 0.34, 4.0, (0.0, 0.12, 0.0)), (1, 0.0, 4.0, (0.0, 0.0, 0.12)),
        (1, 0.40, 3.0, (0.0, -0.12, 0.0)), (-1, 0.0, 2.7, (0.0, 0.0, 0.12)),
        (-1, 0.40, 1.7, (0.0, 0.1, 0.0)), (1, 0.0, 1.8, (0.0, 0.0, 0.02)),
        (0, 0.126, 0.3, (0.0, 0.0, -0.02)),
    )
)  # fmt: skip
SEVEN_JOINTS = tuple(f"lbr_joint_{i + 1}" for i in range(7))


@dataclass(frozen=True)
class WrittenArm:
    """An arm of the benchmark: what the cell says of it, and its names in the models."""

    name: str
    robot: str  # of the cell
    arm: Arm
    joints: tuple[str, ...]

    @property
    def n(self) -> int:
        return self.arm.n


def written_arms() -> dict[str, WrittenArm]:
    """Return the benchmark's arms by name: UR10e, and one with seven joints."""
    rows = "".join(f"\n    - {json.dumps(row)}" for row in SEVEN)
    return {
        "ur10e": WrittenArm("ur10e", "model: ur10e", builtin_arm("ur10e"), UR_JOINTS),
        "seven": WrittenArm("seven", f"dh:{rows}", arm_from_dh(SEVEN), SEVEN_JOINTS),
    }


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{v:.17g}" for v in values)


def frame_turns(n: int) -> list[Rotation]:
    """Return how each body's frame is turned against the joint's frame: any, but known."""
    return [Rotation.from_rotvec([0.2 * i, -0.3, 0.1 * i]) for i in range(n + 1)]


def slid(arm: Arm, distances: np.ndarray) -> Arm:
    """Return the same arm with joint frames elsewhere on their axes: ``distances`` (n,) in m."""
    links, cog = arm.link_in_link.copy(), arm.cog.copy()
    for i, distance in enumerate(distances):
        links[i] = links[i] @ transform(np.eye(3), np.array([0.0, 0.0, distance]))
        links[i + 1] = transform(np.eye(3), np.array([0.0, 0.0, -distance])) @ links[i + 1]
        cog[i] = cog[i] - [0.0, 0.0, distance]
    return replace(arm, link_in_link=links, cog=cog)


@dataclass(frozen=True)
class Soft:
    """What gives way in a written model beside its joints; a bent link is cut into pieces."""

    base: tuple[float, float] = (0.0, 0.0)  # rad/Nm about x and y of base
    link: int = 0  # which link bends, from 1; 0: none
    flexibility: float = 0.0  # 1/(N m2): 1/EI


PIECES = 8  # of a bent link, each with its hinges in the middle


def mjcf(arm: Arm, names: tuple[str, ...], kp: float = 0.0, tcp: float = 0.1,
         load: float = 0.0, soft: Soft | None = None, kv: float = 0.0) -> str:  # fmt: skip
    """Return an MJCF model with body frames that are not the joints' frames."""
    soft = soft or Soft()
    damping = f'kv="{kv}"' if kv else 'dampratio="1"'
    turns = frame_turns(arm.n)
    base = BASE_TURN.as_quat()[[3, 0, 1, 2]]
    text = f'<body name="base" pos="{numbers(BASE_AT)}" quat="{numbers(base)}">'
    if any(soft.base):
        text += '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        text += hinge("foundation_x", "1 0 0", 1 / soft.base[0])
        text += hinge("foundation_y", "0 1 0", 1 / soft.base[1])
    opened = "</body>"
    at, turn = arm.link_in_link[0][:3, 3], Rotation.from_matrix(arm.link_in_link[0][:3, :3])
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
        if soft.link == i + 1:
            text += bent(at, soft.flexibility)
            opened += "</body>" * PIECES
            at = at / (2 * PIECES)
    flange = turn.as_quat()[[3, 0, 1, 2]]
    text += (
        f'<body name="tool" pos="{numbers(at)}" quat="{numbers(flange)}">'
        f'<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
        f'<site name="tcp" pos="0 0 {tcp:.17g}"/><site name="ft"/>'
    )
    opened += "</body>"
    if load:
        text += (
            f'<body name="load" pos="0 0 {tcp:.17g}"><inertial pos="0 0 0" mass="{load}" '
            'diaginertia="1e-4 1e-4 1e-4"/></body>'
        )
    drives = "".join(
        f'<position name="drive_{name}" joint="{name}" kp="{kp}" {damping}/>' for name in names
    )
    keyframe = f'<key name="home" qpos="{numbers(0.1 * np.arange(arm.n))}"/>'
    if any(soft.base) or soft.link:
        keyframe = ""
    return (
        '<mujoco model="arm"><compiler angle="radian"/>'
        '<option timestep="0.001" integrator="implicitfast"/>'
        f"<worldbody>{text}{opened}</worldbody>"
        f"<actuator>{drives if kp else ''}</actuator>"
        '<sensor><force name="ft_force" site="ft"/><torque name="ft_torque" site="ft"/></sensor>'
        f"<keyframe>{keyframe}</keyframe></mujoco>"
    )


def hinge(name: str, axis: str, stiffness: float) -> str:
    """Return a joint with a spring, damped so that it rests soon."""
    return (
        f'<joint name="{name}" axis="{axis}" stiffness="{stiffness:.17g}" '
        f'damping="{max(500.0, 2e-3 * stiffness):.17g}" armature="1e-3"/>'
    )


def bent(along: np.ndarray, flexibility: float) -> str:
    """Return the pieces of a bending link, opened: the last one's frame is in its middle."""
    length = float(np.linalg.norm(along))
    step = along / PIECES
    across = np.linalg.svd(along[None] / length)[2][1:]
    text = ""
    for k in range(PIECES):
        text += f'<body name="piece_{k}" pos="{numbers(step if k else step / 2)}">'
        text += '<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-6 1e-6 1e-6"/>'
        for m, axis in enumerate(across):
            text += hinge(f"piece_{k}_{m}", numbers(axis), PIECES / (length * flexibility))
    return text


def urdf(arm: Arm, names: tuple[str, ...], tcp: float | np.ndarray = 0.1) -> str:
    """Return a URDF whose link frames are not the joints' DH frames, with comments in it.

    ``tcp``: along z of the flange, or its place there (3,).
    """
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
    at = at + turn.apply([0, 0, tcp] if np.ndim(tcp) == 0 else tcp)
    text += (
        f'  <joint name="tool_joint" type="fixed">\n'
        f'    <origin xyz="{numbers(at)}" rpy="{numbers(turn.as_euler("xyz"))}"/>\n'
        f'    <parent link="{parent}"/><child link="tool"/>\n  </joint>\n  <link name="tool"/>\n'
        f'  <transmission name="t"><joint name="{names[0]}"><x/></joint></transmission>\n'
    )
    return text + "</robot>\n"
