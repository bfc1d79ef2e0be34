"""The arms of the benchmark: cobots of 5 and 10 kg, a 7-joint arm, a 200 kg class machine.

Figures are of the class, not of one serial number. The 7-joint arm is handed out as URDF text.
Softness is what such arms have when their nominal model is already compliant.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin

from benchmarks.blind.mechanics import Row


@dataclass(frozen=True)
class ArmKind:
    """One class of arm: its drawing and the sizes that go with it."""

    name: str
    rows: tuple[Row, ...]
    low: tuple[float, ...]  # rad, range of the poses
    high: tuple[float, ...]
    rated: float  # kg
    pull: float  # N, usual outside pull
    axial: tuple[float, ...]  # rad/Nm, usual
    radial: tuple[float, ...]
    tool: float  # m, usual length of a tool
    as_urdf: bool = False

    @property
    def n(self) -> int:
        """Return the number of joints."""
        return len(self.rows)


Point = tuple[float, float, float]


def _row(a: float, alpha: float, d: float, mass: float, cog: Point, offset: float = 0) -> Row:
    return Row(a, alpha, d, offset, mass, cog)


H = pi / 2
UR5E = ArmKind(
    "cobot5",
    (
        _row(0, H, 0.1625, 3.761, (0, -0.02561, 0.00193)),
        _row(-0.425, 0, 0, 8.058, (0.2125, 0, 0.11336)),
        _row(-0.3922, 0, 0, 2.846, (0.15, 0, 0.0265)),
        _row(0, H, 0.1333, 1.37, (0, -0.0018, 0.01634)),
        _row(0, -H, 0.0997, 1.3, (0, 0.0018, 0.01634)),
        _row(0, 0, 0.0996, 0.365, (0, 0, -0.001159)),
    ),
    (-2.9, -2.8, -2.5, -2.9, -2.9, -2.9),
    (2.9, -0.3, 2.5, 2.9, 2.9, 2.9),
    5.0,
    40.0,
    (2e-5, 2e-5, 2.5e-5, 7e-5, 7e-5, 8e-5),
    (8e-6, 6e-6, 8e-6, 2e-5, 2e-5, 2.5e-5),
    0.12,
)
UR10E = ArmKind(
    "cobot10",
    (
        _row(0, H, 0.1807, 7.369, (0.021, 0, 0.027)),
        _row(-0.6127, 0, 0, 13.051, (0.38, 0, 0.158)),
        _row(-0.57155, 0, 0, 3.989, (0.24, 0, 0.068)),
        _row(0, H, 0.17415, 2.1, (0, 0.007, 0.018)),
        _row(0, -H, 0.11985, 1.98, (0, 0.007, 0.018)),
        _row(0, 0, 0.11655, 0.615, (0, 0, -0.026)),
    ),
    (-2.9, -2.8, -2.5, -2.9, -2.9, -2.9),
    (2.9, -0.3, 2.5, 2.9, 2.9, 2.9),
    12.5,
    70.0,
    (1e-5, 1e-5, 1.3e-5, 4e-5, 4e-5, 5e-5),
    (4e-6, 3e-6, 4e-6, 1.2e-5, 1.2e-5, 1.5e-5),
    0.18,
)
SEVEN = ArmKind(
    "seven14",
    (
        _row(0, -H, 0.36, 5.76, (0, 0.12, 0.02)),
        _row(0, H, 0, 6.35, (0, 0.03, 0.06)),
        _row(0, H, 0.42, 3.5, (0, -0.18, 0.03)),
        _row(0, -H, 0, 3.5, (0, 0.05, 0.05)),
        _row(0, -H, 0.4, 3.5, (0, 0.15, 0.02)),
        _row(0, H, 0, 1.8, (0, 0.01, 0.02)),
        _row(0, 0, 0.126, 1.2, (0, 0, -0.04)),
    ),
    (-2.8, -1.9, -2.8, -2.0, -2.8, -2.0, -2.9),
    (2.8, 1.9, 2.8, 2.0, 2.8, 2.0, 2.9),
    14.0,
    60.0,
    (2e-5, 2e-5, 2.5e-5, 2.5e-5, 4e-5, 6e-5, 6e-5),
    (6e-6, 6e-6, 7e-6, 7e-6, 1e-5, 2e-5, 2e-5),
    0.15,
    as_urdf=True,
)
HEAVY = ArmKind(
    "heavy210",
    (
        _row(0.35, -H, 0.675, 330.0, (-0.25, 0.2, 0.02)),
        _row(1.15, 0, 0, 210.0, (-0.6, 0.02, -0.12), -H),
        _row(-0.041, -H, 0, 260.0, (-0.08, 0.03, 0.25)),
        _row(0, H, 1.2, 75.0, (0, -0.35, 0.01)),
        _row(0, -H, 0, 40.0, (0, 0.01, 0.05)),
        _row(0, 0, 0.215, 18.0, (0, 0, -0.06)),
    ),
    (-2.9, -0.6, -0.9, -2.9, -2.0, -2.9),
    (2.9, 1.1, 1.4, 2.9, 2.0, 2.9),
    210.0,
    900.0,
    (2.5e-7, 2.5e-7, 3e-7, 1.5e-6, 1.8e-6, 2.5e-6),
    (8e-8, 8e-8, 1e-7, 4e-7, 5e-7, 6e-7),
    0.3,
)
ARMS = {arm.name: arm for arm in (UR5E, UR10E, SEVEN, HEAVY)}


def urdf_text(arm: ArmKind) -> str:
    """Return the arm as URDF: one link a joint, every axis z, the flange as the last link."""
    out = [f'<robot name="{arm.name}">', '  <link name="base"/>']
    where, parent = "0 0 0", "base"
    twist = 0.0
    for i, row in enumerate(arm.rows, 1):
        if row.offset:
            raise ValueError("an arm handed out as URDF has no zero offsets here")
        cog = _cog_in_joint(row)
        out += [
            f'  <link name="link_{i}"><inertial><origin xyz="{cog[0]} {cog[1]} {cog[2]}"/>',
            f'    <mass value="{row.mass}"/>',
            '    <inertia ixx="1e-6" ixy="0" ixz="0" iyy="1e-6" iyz="0" izz="1e-6"/>',
            "  </inertial></link>",
            f'  <joint name="joint_{i}" type="revolute">',
            f'    <parent link="{parent}"/><child link="link_{i}"/><axis xyz="0 0 1"/>',
            f'    <origin xyz="{where}" rpy="{twist!r} 0 0"/>',
            f'    <limit lower="{arm.low[i - 1] - 0.1}" upper="{arm.high[i - 1] + 0.1}" '
            'velocity="2" effort="400"/>',
            "  </joint>",
        ]
        where, twist, parent = f"{row.a!r} 0 {row.d!r}", row.alpha, f"link_{i}"
    out += [
        '  <link name="flange"/>',
        '  <joint name="flange_fixed" type="fixed">',
        f'    <parent link="{parent}"/><child link="flange"/>',
        f'    <origin xyz="{where}" rpy="{twist!r} 0 0"/>',
        "  </joint>",
        "</robot>",
    ]
    return "\n".join(out) + "\n"


def _cog_in_joint(row: Row) -> tuple[float, float, float]:
    """Return the centre of gravity in the joint's frame; DH states it at the row's far end."""
    x, y, z = row.cog
    ca, sa = cos(row.alpha), sin(row.alpha)
    return (row.a + x, ca * y - sa * z, row.d + sa * y + ca * z)
