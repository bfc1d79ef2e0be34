"""Where an MJCF model of a UR has its TCP."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.patch.arms import BASE_AT, BASE_TURN, UR_JOINTS


def tcp_in_base(text: str, q: np.ndarray, held: bool = False) -> np.ndarray:
    """Return the TCP (3,) of an MJCF model in base at ``q`` (6,); ``held``: where it rests."""
    mujoco = pytest.importorskip("mujoco")
    compiled = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(compiled)
    for name, angle in zip(UR_JOINTS, q, strict=True):
        joint = compiled.joint(name)
        data.qpos[joint.qposadr[0]] = angle
        compiled.dof_armature[joint.dofadr[0]] = 1e12  # a rotor that nothing turns
    mujoco.mj_forward(compiled, data)
    if held:
        mujoco.mj_step(compiled, data, nstep=3000)
    return BASE_TURN.inv().apply(data.site("tcp").xpos - BASE_AT)
