"""Arms as the makers' papers give them, forward kinematics, and a first tool point.

Nothing here is shared with the model under test. Standard DH rows; SI units.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
H = pi / 2


@dataclass(frozen=True)
class Link:
    """One standard DH row with what hangs on it."""

    a: float
    alpha: float
    d: float
    offset: float = 0.0
    mass: float = 0.0  # kg
    cog: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, frame of the row

    def document(self) -> dict[str, Any]:
        """Return the row as it stands in a cell file."""
        row: dict[str, Any] = {"a": self.a, "alpha": self.alpha, "d": self.d, "offset": self.offset}
        return row | ({"mass": self.mass, "cog": list(self.cog)} if self.mass else {})


def _links(*rows: tuple[Any, ...]) -> tuple[Link, ...]:
    return tuple(Link(*row) for row in rows)


# Universal Robots, "DH parameters for calculations of kinematics and dynamics"
UR3E = _links(
    (0, H, 0.15185, 0, 1.98, (0, -0.02, 0)),
    (-0.24355, 0, 0, 0, 3.4445, (0.13, 0, 0.1157)),
    (-0.2132, 0, 0, 0, 1.437, (0.05, 0, 0.0238)),
    (0, H, 0.13105, 0, 0.871, (0, 0, 0.01)),
    (0, -H, 0.08535, 0, 0.805, (0, 0, 0.01)),
    (0, 0, 0.0921, 0, 0.261, (0, 0, -0.02)),
)
UR10E = _links(
    (0, H, 0.1807, 0, 7.369, (0.021, 0, 0.027)),
    (-0.6127, 0, 0, 0, 13.051, (0.38, 0, 0.158)),
    (-0.57155, 0, 0, 0, 3.989, (0.24, 0, 0.068)),
    (0, H, 0.17415, 0, 2.1, (0, 0.007, 0.018)),
    (0, -H, 0.11985, 0, 1.98, (0, 0.007, 0.018)),
    (0, 0, 0.11655, 0, 0.615, (0, 0, -0.026)),
)
UR10 = _links(
    (0, H, 0.1273, 0, 7.1, (0.021, 0, 0.027)),
    (-0.612, 0, 0, 0, 12.7, (0.38, 0, 0.158)),
    (-0.5723, 0, 0, 0, 4.27, (0.24, 0, 0.068)),
    (0, H, 0.163941, 0, 2.0, (0, 0.007, 0.018)),
    (0, -H, 0.1157, 0, 2.0, (0, 0.007, 0.018)),
    (0, 0, 0.0922, 0, 0.365, (0, 0, -0.026)),
)
# KUKA iiwa 7 R800; masses and centres of gravity as in the data set's own model
IIWA7 = _links(
    (0, -H, 0.34, 0, 2.7, (0.00016, -0.02567, -0.08037)),
    (0, H, 0, 0, 2.7, (-0.00003, 0.08884, -0.02773)),
    (0, -H, 0.4, pi, 2.7, (-0.00005, 0.02771, -0.08039)),
    (0, H, 0, 0, 2.7, (0.00003, 0.08892, 0.02571)),
    (0, -H, 0.4, pi, 1.7, (0.00003, -0.02536, -0.09564)),
    (0, H, 0, 0, 1.6, (0.00021, -0.00579, -0.0088)),
    (0, 0, 0.126, 0, 1.4, (-0.00632, -0.00055, 0.06042)),
)
# KUKA iiwa 14 R820 and Kinova Gen3 lite, by their public descriptions
IIWA14 = _links(
    (0, -H, 0.36), (0, H, 0), (0, H, 0.42), (0, -H, 0), (0, -H, 0.4), (0, H, 0), (0, 0, 0.126),
)  # fmt: skip
GEN3_LITE = _links(
    (0, H, 0.24325),
    (0.28, pi, 0.03, H),
    (0, H, 0.02, H),
    (0, H, 0.245, H),
    (0, H, 0.057, pi),
    (0, 0, 0.105, H),
)
# Yaskawa Motoman MA1400, the right arm beyond its common torso; the rows of the data set
MA1400 = _links(
    (0.150, -H, 1.4159),
    (0.614, pi, 0, -H),
    (0.200, -H, 0),
    (0, H, -0.640),
    (0.030, H, 0, -H),
    (0, 0, 0.200),
)
# ABB IRB 120, product manual
IRB120 = _links(
    (0, -H, 0.29),
    (0.27, 0, 0, -H),
    (0.07, -H, 0),
    (0, H, 0.302),
    (0, -H, 0),
    (0, 0, 0.072, pi),
)
# KUKA Quantec Ultra KR300, 200 kg at its flange; the rows of the data set, whose base looks down
KR300 = _links(
    (0.35, H, -0.675, 0, 395.4, (-0.353, 0.174, -0.004)),
    (1.15, 0, -0.189, 0, 339.12, (-0.709, -0.001, 0.023)),
    (0.041, -H, 0.189, H, 105.21, (-0.018, -0.018, -0.076)),
    (0, H, -1.0, 0, 35.8, (0, 0.236, 0.001)),
    (0, -H, 0, 0, 31.46, (0, -0.08, -0.009)),
    (0, pi, -0.24, 0, 217.78, (0, 0, 0.08775)),
)
# Staubli TX2-90L, product manual; the base's height is the frame's
TX2_90L = _links(
    (0.05, -H, 0),
    (0.5, 0, 0, -H),
    (0, H, 0.05, H),
    (0, -H, 0.55),
    (0, H, 0),
    (0, 0, 0.1),
)
# Rokae, six axes: the rows of the data set
ROKAE = _links(
    (0.085, -H, 0.487),
    (0.64, 0, 0, -H),
    (0.205, -H, 0),
    (0, H, 0.72),
    (0, -H, 0),
    (0, 0, 0.075, pi),
)
# Mecademic Meca500, product manual
MECA500 = _links(
    (0, -H, 0.135),
    (0.135, 0, 0, -H),
    (0.038, -H, 0),
    (0, H, 0.12),
    (0, -H, 0),
    (0, 0, 0.07, pi),
)
# AUBO i5: lengths, masses and centres of gravity of the data set's own model
AUBO_I5 = _links(
    (0, -H, 0.122, pi, 5.05, (0, -0.0006, 0.0038)),
    (0.408, pi, 0.1215, -H, 11.28, (-0.204, 0, -0.0196)),
    (0.376, pi, 0, 0, 2.88, (-0.1061, 0, -0.0992)),
    (0, -H, 0, -H, 1.62, (0, 0.078, -0.0997)),
    (0, H, 0.1025, 0, 1.62, (0, -0.003, 0.0028)),
    (0, 0, 0.094, 0, 0.5, (0, 0, -0.0442)),
)
# Doosan M1013 with a drilling tool of 3 kg on its last link: the data set's own URDF
M1013 = _links(
    (0, -H, 0.1525, 0, 7.8, (0.0001, 0.0064, 0.0428)),
    (0.62, 0, 0.0345, -H, 10.83, (-0.3603, 0, 0.1579)),
    (0, H, 0, H, 3.68, (0, 0.0447, 0.0067)),
    (0, -H, 0.559, 0, 3.82, (0.0002, 0.1825, 0.0921)),
    (0, H, 0, 0, 2.82, (-0.0002, 0.0323, -0.0037)),
    (0, 0, 0.121, 0, 4.16, (0.0001, 0.0003, 0.1653)),
)
# FANUC R-2000iB/165F, product manual; its zero is the height of joint 2
R2000 = _links(
    (0.312, -H, 0),
    (1.075, 0, 0, -H),
    (0.225, -H, 0),
    (0, H, 1.28),
    (0, -H, 0),
    (0, 0, 0.215),
)
# QKM HL6: the lengths of the data set
QKM = _links(
    (0, -H, 0.491),
    (0.35, 0, 0, -H),
    (0, -H, 0, -H),
    (0, H, 0.35),
    (0, -H, 0),
    (0, 0, 0.084),
)
# Franka Emika Panda by rows, for least squares of positions
PANDA = _links(
    (0, -H, 0.333),
    (0, H, 0),
    (0.0825, H, 0.316),
    (-0.0825, -H, 0),
    (0, H, 0.384),
    (0.088, H, 0),
    (0, 0, 0.107),
)
# three axes in one point: every attitude of a flange, where a data set gives attitudes, no joints
WRIST = _links((0, -H, 0), (0, H, 0), (0, 0, 0))

# Franka Emika Panda: origins of the joints and inertials as its public description gives them
PANDA_ORIGINS = (
    ((0, 0, 0.333), 0.0), ((0, 0, 0), -H), ((0, -0.316, 0), H), ((0.0825, 0, 0), H),
    ((-0.0825, 0.384, 0), -H), ((0, 0, 0), H), ((0.088, 0, 0), H),
)  # fmt: skip
PANDA_FLANGE = (0, 0, 0.107)
PANDA_LINKS = (
    (4.970684, (0.003875, 0.002081, -0.04762),
     (0.70337, -0.000139, 0.006772, 0.70661, 0.019169, 0.009117)),
    (0.646926, (-0.003141, -0.02872, 0.003495),
     (0.007962, -0.003925, 0.010254, 0.02811, 0.000704, 0.025995)),
    (3.228604, (0.027518, 0.039252, -0.066502),
     (0.037242, -0.004761, -0.011396, 0.036155, -0.012805, 0.01083)),
    (3.587895, (-0.05317, 0.104419, 0.027454),
     (0.025853, 0.007796, -0.001332, 0.019552, 0.008641, 0.028323)),
    (1.225946, (-0.011953, 0.041065, -0.038437),
     (0.035549, -0.002117, -0.004037, 0.029474, 0.000229, 0.008627)),
    (1.666555, (0.060149, -0.014117, -0.010517),
     (0.001964, 0.000109, -0.001158, 0.004354, 0.000341, 0.005433)),
    (0.735522, (0.010517, -0.004252, 0.061597),
     (0.012516, -0.000428, -0.001196, 0.010027, -0.000741, 0.004815)),
)  # fmt: skip


def panda_urdf() -> str:
    """Return the Panda as URDF text, flange ``flange``."""
    out = ['<robot name="panda">', '  <link name="base"/>']
    for i, ((xyz, turn), (mass, cog, inertia)) in enumerate(
        zip(PANDA_ORIGINS, PANDA_LINKS, strict=True), 1
    ):
        names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        moments = " ".join(f'{n}="{v}"' for n, v in zip(names, inertia, strict=True))
        out += [
            f'  <link name="link_{i}"><inertial>',
            f'    <origin xyz="{_text(cog)}"/><mass value="{mass}"/><inertia {moments}/>',
            "  </inertial></link>",
            f'  <joint name="joint_{i}" type="revolute">',
            f'    <parent link="{"base" if i == 1 else f"link_{i - 1}"}"/>'
            f'<child link="link_{i}"/><axis xyz="0 0 1"/>',
            f'    <origin xyz="{_text(xyz)}" rpy="{turn!r} 0 0"/>',
            '    <limit lower="-3.1" upper="3.8" velocity="2.6" effort="87"/>',
            "  </joint>",
        ]
    out += [
        '  <link name="flange"/>',
        '  <joint name="flange_fixed" type="fixed"><parent link="link_7"/><child link="flange"/>',
        f'    <origin xyz="{_text(PANDA_FLANGE)}"/></joint>',
        "</robot>",
    ]
    return "\n".join(out) + "\n"


def _text(values: tuple[float, ...]) -> str:
    return " ".join(f"{v:g}" for v in values)


def links_of(rows: list[dict[str, Any]]) -> tuple[Link, ...]:
    """Return the rows of a cell file."""
    return tuple(
        Link(
            float(r["a"]), float(r["alpha"]), float(r["d"]), float(r.get("offset", 0)),
            float(r.get("mass", 0)), tuple(float(x) for x in r.get("cog", (0, 0, 0))),
        )
        for r in rows
    )  # fmt: skip


def flange(links: tuple[Link, ...], q: Array, change: Array | None = None) -> tuple[Array, Array]:
    """Return flange positions (N, 3) and rotations (N, 3, 3) in base at joints (N, n).

    ``change`` (n, 5) is added to d, a, alpha, joint angle and a twist beta about y.
    """
    count, n = q.shape
    more = np.zeros((n, 5)) if change is None else change
    p, R = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))
    for i, link in enumerate(links):
        d, a, alpha, theta, beta = more[i]
        angle = q[:, i] + link.offset + theta
        c, s = np.cos(angle), np.sin(angle)
        zero, one = np.zeros(count), np.ones(count)
        Z = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
        R = R @ Z
        p = p + R @ np.array([link.a + a, 0.0, link.d + d])
        R = R @ _about(0, link.alpha + alpha) @ _about(1, beta)
    return p, R


def _about(axis: int, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    if axis == 0:
        return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def attitude_joints(rotation: Array) -> Array:
    """Return the angles (N, 3) of ``WRIST`` whose flange has these rotations (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_euler("ZYZ"))
