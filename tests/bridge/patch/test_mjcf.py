"""MJCF of users: joints with ref, other actuators, masses elsewhere, names and files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.patch.arms import BASE_AT, BASE_TURN, UR_JOINTS, mjcf, numbers
from gapbridge.bridge.patch import Patched, PatchOptions, changes_of, format_of
from gapbridge.core.arm import builtin_arm
from gapbridge.core.effects import Site, Term
from gapbridge.core.model import Model

mujoco = pytest.importorskip("mujoco")

ARM = builtin_arm("ur10e")
TOOL = np.eye(4)
TOOL[2, 3] = 0.1
NOMINAL = Model(ARM, TOOL)
OFFSET = NOMINAL.with_terms([Term("joint_offset", Site(3), (0.004,))])
SIX_DIGITS = 5e-6  # of MuJoCo's own writer
Q = np.array([0.3, -0.9, 1.2, -0.4, 0.7, 0.2])


def patched(path: Path, text: str, model: Model, options: PatchOptions) -> Patched:
    path.write_text(text)
    return format_of(path).patch(path, changes_of(model), options, [])


def tcp_in_base(text: str, held: bool = False) -> np.ndarray:
    """Return the TCP (3,) of an MJCF model in base at Q, or where it rests with the joints held."""
    compiled = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(compiled)
    for name, angle in zip(UR_JOINTS, Q, strict=True):
        joint = compiled.joint(name)
        data.qpos[joint.qposadr[0]] = angle
        compiled.dof_armature[joint.dofadr[0]] = 1e12  # a rotor that nothing turns
    mujoco.mj_forward(compiled, data)
    if held:
        mujoco.mj_step(compiled, data, nstep=3000)
    return BASE_TURN.inv().apply(data.site("tcp").xpos - BASE_AT)


def with_refs(text: str, ref: float) -> str:
    """Return the same model with a ref (rad) of every joint: its bodies stand at that angle."""
    spec = mujoco.MjSpec.from_string(text)
    for name in UR_JOINTS:
        joint = spec.joint(name)
        turn = Rotation.from_quat(np.array(joint.parent.quat)[[1, 2, 3, 0]])
        turn = turn * Rotation.from_rotvec(ref * np.array(joint.axis))
        text = re.sub(
            rf'(<body name="{joint.parent.name}" pos="[^"]*" quat=)"[^"]*"',
            rf'\1"{numbers(turn.as_quat()[[3, 0, 1, 2]])}"', text,
        )  # fmt: skip
    return re.sub(r"(<joint name=)", rf'<joint ref="{ref}" name=', text)


def test_joints_with_ref_keep_their_zero_where_their_body_moves(tmp_path: Path) -> None:
    given = with_refs(mjcf(ARM, UR_JOINTS), 0.5)
    model = NOMINAL.with_terms([
        Term("joint_offset", Site(3), (0.004,)),
        Term("link_geometry", Site(4), (-1e-3, 2e-3, 1e-3)),
    ])  # fmt: skip
    before = NOMINAL.predict(Q[None]).position[0]
    assert np.allclose(tcp_in_base(given), before, rtol=0, atol=SIX_DIGITS)
    found = patched(tmp_path / "a.xml", given, model, PatchOptions(tcp="tcp"))
    expected = model.predict(Q[None]).position[0]
    assert np.allclose(tcp_in_base(found.text), expected, rtol=0, atol=SIX_DIGITS)


@pytest.mark.parametrize(
    "term",
    [
        Term("base_compliance", Site(), (2e-5, 1e-5)),
        Term("link_flexibility", Site(2), (2e-5,)),
        Term("radial_compliance", Site(2), (2e-5,)),
    ],
    ids=["base", "link", "radial"],
)
def test_springs_of_joints_with_ref_bend_as_predicted(tmp_path: Path, term: Term) -> None:
    model = NOMINAL.with_terms([term])
    given = with_refs(mjcf(ARM, UR_JOINTS), 0.5)
    found = patched(tmp_path / "a.xml", given, model, PatchOptions(tcp="tcp"))
    deflected, rigid = model.predict(Q[None]).position[0], NOMINAL.predict(Q[None]).position[0]
    off = np.linalg.norm(tcp_in_base(found.text, held=True) - deflected)
    assert off < 0.01 * np.linalg.norm(deflected - rigid)
