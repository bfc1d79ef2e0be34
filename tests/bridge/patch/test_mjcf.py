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


SERVO = NOMINAL.with_terms([
    Term("servo_droop", Site(2), (3e-5,)), Term("latency", Site(2), (0.02,)),
    Term("tracking_lag", Site(2), (0.02,)),
])  # fmt: skip


def with_actuators(*elements: str) -> str:
    """Return the model with actuators, ``{joint}`` replaced by each joint."""
    written = "".join(e.format(joint=name) for name in UR_JOINTS for e in elements)
    given = mjcf(ARM, UR_JOINTS)
    return given.replace("<actuator></actuator>", f"<actuator>{written}</actuator>")


@pytest.mark.parametrize(
    "element",
    [
        '<motor joint="{joint}" gear="100"/>',
        '<velocity joint="{joint}" kv="100"/>',
        '<intvelocity joint="{joint}" kp="100" actrange="-3 3"/>',
    ],
    ids=["motor", "velocity", "intvelocity"],
)
def test_an_actuator_that_holds_no_position_stays_as_it_is(tmp_path: Path, element: str) -> None:
    given = with_actuators(element)
    found = patched(tmp_path / "a.xml", given, SERVO, PatchOptions())
    after, before = (mujoco.MjModel.from_xml_string(t) for t in (found.text, given))
    for key in ("gainprm", "biasprm", "dyntype", "dynprm", "delay"):
        name = f"actuator_{key}"
        assert np.array_equal(getattr(after, name), getattr(before, name)), name
    assert any("shoulder_lift_joint: it has no position actuator" in m for m in found.unsupported)


@pytest.mark.parametrize("on_top", [False, True])
def test_droop_is_the_position_actuators_beside_another_one_and_over_a_gear(
    tmp_path: Path, on_top: bool
) -> None:
    given = with_actuators(
        '<velocity joint="{joint}" kv="100"/>', '<position joint="{joint}" kp="200" gear="10"/>'
    )
    found = patched(tmp_path / "a.xml", given, SERVO, PatchOptions(on_top=on_top))
    after, before = (mujoco.MjModel.from_xml_string(t) for t in (found.text, given))
    velocity, position = 2, 3  # of the second joint
    assert after.actuator_gainprm[velocity, 0] == before.actuator_gainprm[velocity, 0]
    assert after.actuator_dyntype[velocity] == before.actuator_dyntype[velocity]
    droop = 1 / (after.actuator_gainprm[position, 0] * 10**2)
    assert droop == pytest.approx(3e-5 + (1 / (200 * 10**2) if on_top else 0), rel=1e-5)
    assert after.actuator_dyntype[position] == mujoco.mjtDyn.mjDYN_FILTEREXACT
    assert not found.unsupported
