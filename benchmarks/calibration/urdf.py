"""An arm as URDF, for other programs."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gapbridge.core.arm import Arm


def urdf_of(arm: Arm) -> str:
    """Return the URDF of an arm: every axis z, the flange as the last link."""
    out = ['<robot name="arm">', '  <link name="base"/>']
    parent = "base"
    for i in range(arm.n):
        cog = " ".join(f"{v:.12g}" for v in arm.cog[i])
        mass = max(float(arm.mass[i]), 1e-6)
        out += [
            f'  <link name="link_{i + 1}"><inertial><origin xyz="{cog}"/><mass value="{mass!r}"/>',
            '    <inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/>',
            "  </inertial></link>",
            f'  <joint name="joint_{i + 1}" type="revolute">',
            f'    <parent link="{parent}"/><child link="link_{i + 1}"/><axis xyz="0 0 1"/>',
            f"    {_origin(arm, i)}",
            '    <limit lower="-6.3" upper="6.3" velocity="3" effort="1000"/>',
            "  </joint>",
        ]
        parent = f"link_{i + 1}"
    out += [
        '  <link name="flange"/>',
        '  <joint name="flange_fixed" type="fixed">',
        f'    <parent link="{parent}"/><child link="flange"/>',
        f"    {_origin(arm, arm.n)}",
        "  </joint>",
        "</robot>",
    ]
    return "\n".join(out) + "\n"


def _origin(arm: Arm, i: int) -> str:
    step = arm.link_in_link[i]
    xyz = " ".join(f"{v:.15g}" for v in step[:3, 3])
    rpy = " ".join(
        f"{v:.15g}" for v in Rotation.from_matrix(np.array(step[:3, :3])).as_euler("xyz")
    )
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'
