"""Patched models against the product's own prediction: MuJoCo and Pinocchio run them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mjcf_pose import tcp_in_base

from benchmarks.patch.arms import (
    BASE_AT,
    BASE_TURN,
    UR_JOINTS,
    frame_turns,
    mjcf,
    slid,
    urdf,
    written_arms,
)
from gapbridge.bridge.patch import PatchOptions, changes_of, format_of
from gapbridge.core.arm import arm_from_dh, builtin_arm
from gapbridge.core.effects import Site, Term
from gapbridge.core.effects.effect import typical_moment
from gapbridge.core.errors import InputError
from gapbridge.core.model import Model

mujoco = pytest.importorskip("mujoco")
pinocchio = pytest.importorskip("pinocchio")

ARM = builtin_arm("ur10e")
TOOL = np.eye(4)
TOOL[2, 3] = 0.1
NOMINAL = Model(ARM, TOOL)
GEOMETRY = (
    Term("joint_offset", Site(3), (0.004,)),
    Term("link_geometry", Site(1), (1e-3, -2e-3, 3e-3)),
    Term("link_geometry", Site(2), (2e-3, 1e-3, -1e-3, 2e-3)),
    Term("link_geometry", Site(4), (-1e-3, 2e-3, 1e-3)),
    Term("tool_frame", Site(), (1e-3, 2e-3, -1e-3, 0.0, 0.0, 0.0)),
)
SIX_DIGITS = 5e-6  # of MuJoCo's own writer
SOME_Q = np.random.default_rng(5).uniform(-2, 2, (12, 6))


def patched(path: Path, text: str, model: Model, tcp: str) -> tuple[str, list[str], list[str]]:
    path.write_text(text)
    found = format_of(path).patch(path, changes_of(model), PatchOptions(tcp=tcp), ["a note"])
    return found.text, list(found.changed), list(found.unsupported)


def fitting(terms: tuple[Term, ...]) -> tuple[Term, ...]:
    """Return the terms with as many values as their effects have."""
    from gapbridge.core.effects import CATALOGUE

    return tuple(
        Term(t.effect, t.site, t.values[: len(CATALOGUE[t.effect].parameters(ARM, t.site))])
        for t in terms
    )


def in_base(position: np.ndarray) -> np.ndarray:
    return BASE_TURN.inv().apply(position - BASE_AT)


def test_a_patched_urdf_is_where_predict_is(tmp_path: Path) -> None:
    model = NOMINAL.with_terms(fitting(GEOMETRY))
    text, _, missing = patched(tmp_path / "a.urdf", urdf(ARM, UR_JOINTS), model, "tool")
    (tmp_path / "b.urdf").write_text(text)
    robot = pinocchio.buildModelFromUrdf(str(tmp_path / "b.urdf"))
    data, frame = robot.createData(), robot.getFrameId("tool")
    expected = model.predict(SOME_Q)
    for k, q in enumerate(SOME_Q):
        pinocchio.framesForwardKinematics(robot, data, q)
        found = data.oMf[frame]
        assert np.allclose(found.translation, expected.position[k], rtol=0, atol=1e-9)
        assert np.allclose(found.rotation, expected.rotation[k], rtol=0, atol=1e-9)
    assert not missing


def test_a_urdf_keeps_its_comments_order_and_what_does_not_change(tmp_path: Path) -> None:
    given = urdf(ARM, UR_JOINTS)
    model = NOMINAL.with_terms([Term("joint_offset", Site(3), (0.004,)),
                                Term("coulomb_friction", Site(2), (4.0,))])  # fmt: skip
    text, _, _ = patched(tmp_path / "a.urdf", given, model, "")
    before, after = given.splitlines(), text.splitlines()
    new = [line for line in after if line not in before]
    gone = [line for line in before if line not in after]
    assert len(gone) == 1
    assert "<origin" in gone[0]
    assert sum("<dynamics" in line for line in new) == 1
    assert "<!-- kept -->" in text
    assert '<!-- origin xyz="9 9 9" -->' in text


def test_a_patched_mjcf_is_where_predict_is(tmp_path: Path) -> None:
    model = NOMINAL.with_terms(fitting(GEOMETRY))
    text, _, missing = patched(tmp_path / "a.xml", mjcf(ARM, UR_JOINTS), model, "tcp")
    compiled = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(compiled)
    expected = model.predict(SOME_Q)
    for k, q in enumerate(SOME_Q):
        data.qpos[:] = q
        mujoco.mj_forward(compiled, data)
        found = data.site("tcp")
        assert np.allclose(in_base(found.xpos), expected.position[k], rtol=0, atol=SIX_DIGITS)
        turned = BASE_TURN.as_matrix().T @ found.xmat.reshape(3, 3)
        assert np.allclose(turned, expected.rotation[k], rtol=0, atol=SIX_DIGITS)
    assert not missing


@pytest.mark.parametrize(
    "terms",
    [
        [Term("axial_compliance", Site(2), (2e-5,)), Term("axial_compliance", Site(3), (4e-5,))],
        [Term("radial_compliance", Site(2), (2e-5,)), Term("radial_compliance", Site(4), (5e-5,))],
        [Term("stiffness_nonlinearity", Site(2), (2e-5, 1 / 900.0**2))],
    ],
    ids=["axial", "radial", "nonlinear"],
)
def test_springs_bend_as_predicted(tmp_path: Path, terms: list[Term]) -> None:
    model = NOMINAL.with_terms(terms)
    text, changed, _ = patched(tmp_path / "a.xml", mjcf(ARM, UR_JOINTS), model, "tcp")
    q = np.array([0.3, -0.6, 0.9, -0.4, 1.1, 0.2])
    deflected, rigid = model.predict(q[None]).position[0], NOMINAL.predict(q[None]).position[0]
    found = tcp_in_base(text, q, held=True)
    assert np.linalg.norm(found - deflected) < 0.01 * np.linalg.norm(deflected - rigid)
    assert any("nq is" in line for line in changed)


@pytest.mark.parametrize("effect", ["axial_compliance", "radial_compliance"])
def test_springs_bend_as_predicted_where_the_models_joints_are_elsewhere_on_their_axes(
    tmp_path: Path, effect: str
) -> None:
    """As in Menagerie's UR10e, whose upper arm begins 176 mm along the axis of its joint."""
    model = NOMINAL.with_terms([Term(effect, Site(2), (2e-5,))])
    given = mjcf(slid(ARM, np.array([0.0, 0.176, 0.039, 0.0, 0.0, 0.0])), UR_JOINTS)
    text, _, _ = patched(tmp_path / "a.xml", given, model, "tcp")
    q = np.array([0.3, -0.9, 1.2, -0.4, 0.7, 0.2])
    deflected, rigid = model.predict(q[None]).position[0], NOMINAL.predict(q[None]).position[0]
    found = tcp_in_base(text, q, held=True)
    assert np.linalg.norm(found - deflected) < 0.01 * np.linalg.norm(deflected - rigid)


def test_keyframes_still_hold_the_joints_angles(tmp_path: Path) -> None:
    model = NOMINAL.with_terms([Term("radial_compliance", Site(2), (2e-5,))])
    text, _, _ = patched(tmp_path / "a.xml", mjcf(ARM, UR_JOINTS), model, "tcp")
    compiled = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(compiled)
    mujoco.mj_resetDataKeyframe(compiled, data, 0)
    at = [data.joint(name).qpos[0] for name in UR_JOINTS]
    assert np.allclose(at, 0.1 * np.arange(6))


def test_moving_effects_become_the_joints_and_actuators_own(tmp_path: Path) -> None:
    model = NOMINAL.with_terms([
        Term("coulomb_friction", Site(1), (3.0,)), Term("viscous_friction", Site(2), (5.0,)),
        Term("rotor_inertia", Site(3), (0.4,)), Term("latency", Site(4), (0.02,)),
        Term("tracking_lag", Site(5), (0.05,)), Term("backlash", Site(6), (0.002,)),
        Term("link_inertia", Site(2), (0.1,)), Term("payload", Site(), (1.5,)),
    ])  # fmt: skip
    given = mjcf(ARM, UR_JOINTS, kp=1e4)
    text, _, missing = patched(tmp_path / "a.xml", given, model, "tcp")
    compiled, before = (mujoco.MjModel.from_xml_string(t) for t in (text, given))
    dof = [compiled.joint(name).dofadr[0] for name in UR_JOINTS]
    assert compiled.dof_frictionloss[dof[0]] == pytest.approx(3.0)
    assert np.ravel(compiled.dof_damping[dof[1]])[0] == pytest.approx(5.0)
    assert compiled.dof_armature[dof[2]] == pytest.approx(0.4)
    half = 0.5 * compiled.opt.timestep  # by which a sampled filter answers earlier
    assert compiled.actuator_dynprm[4, 0] == pytest.approx(0.05 + half)
    play = compiled.joint("wrist_3_joint_backlash")
    assert np.allclose(play.range, [-0.001, 0.001])
    ratio = compiled.body("link_2").mass[0] / before.body("link_2").mass[0]
    assert ratio == pytest.approx(1.1)
    assert compiled.body("payload_difference").mass[0] == pytest.approx(1.5)
    assert not missing


@pytest.mark.parametrize("on_top", [False, True])
def test_a_servo_gives_way_as_much_as_the_cell_says(tmp_path: Path, on_top: bool) -> None:
    """A droop diagnosed against the simulator is added to the simulator's own."""
    kp, droop = 1e4, 3e-5
    (tmp_path / "a.xml").write_text(given := mjcf(ARM, UR_JOINTS, kp=kp))
    model = NOMINAL.with_terms([Term("servo_droop", Site(3), (droop,))])
    options = PatchOptions(tcp="tcp", on_top=on_top)
    done = format_of(tmp_path / "a.xml").patch(tmp_path / "a.xml", changes_of(model), options, [])
    after, before = (mujoco.MjModel.from_xml_string(t) for t in (done.text, given))
    wanted = 1 / (droop + (1 / kp if on_top else 0))
    assert after.actuator_gainprm[2, 0] == pytest.approx(wanted, rel=1e-5)
    assert after.actuator_biasprm[2, 1] == pytest.approx(-wanted, rel=1e-5)
    ratio = after.actuator_biasprm[2, 2] / before.actuator_biasprm[2, 2]
    assert ratio == pytest.approx(np.sqrt(wanted / kp), rel=1e-3)  # as well damped as before


FRICTION = 'friction="10" damping="20"'  # a URDF's, as damping and friction may stand in it
JOINT_EFFECTS = NOMINAL.with_terms([
    Term("coulomb_friction", Site(1), (3.0,)), Term("viscous_friction", Site(1), (5.0,)),
    Term("rotor_inertia", Site(1), (0.4,)),
])  # fmt: skip


@pytest.mark.parametrize("on_top", [False, True])
def test_a_joint_that_has_friction_has_the_cells_instead_or_both_where_it_was_simulated(
    tmp_path: Path, on_top: bool
) -> None:
    options = PatchOptions(on_top=on_top)
    mine = mjcf(ARM, UR_JOINTS).replace(
        'armature="0"', 'armature="0.1" damping="20" frictionloss="10"'
    )
    (tmp_path / "a.xml").write_text(mine)
    (tmp_path / "a.urdf").write_text(
        urdf(ARM, UR_JOINTS).replace("<limit", f"<dynamics {FRICTION}/><limit", 1)
    )
    xml, text = (
        format_of(tmp_path / name)
        .patch(tmp_path / name, changes_of(JOINT_EFFECTS), options, [])
        .text
        for name in ("a.xml", "a.urdf")
    )
    compiled = mujoco.MjModel.from_xml_string(xml)
    own = (10.0, 20.0, 0.1) if on_top else (0.0, 0.0, 0.0)
    dof = compiled.joint(UR_JOINTS[0]).dofadr[0]
    assert compiled.dof_frictionloss[dof] == pytest.approx(3.0 + own[0])
    assert np.ravel(compiled.dof_damping[dof])[0] == pytest.approx(5.0 + own[1])
    assert compiled.dof_armature[dof] == pytest.approx(0.4 + own[2])
    assert f'<dynamics friction="{3 + own[0]:g}" damping="{5 + own[1]:g}"/>' in text


@pytest.mark.parametrize(("share", "off"), [(1.0, None), (0.5, "20 %"), (0.3, "40 %")])
def test_a_spring_that_cannot_stiffen_as_early_is_listed_with_its_error(
    tmp_path: Path, share: float, off: str | None
) -> None:
    softening = 1 / (share * typical_moment(ARM)) ** 2
    model = NOMINAL.with_terms([Term("stiffness_nonlinearity", Site(2), (4e-5, softening))])
    _, _, missing = patched(tmp_path / "a.xml", mjcf(ARM, UR_JOINTS), model, "tcp")
    assert [line for line in missing if "stiffening of shoulder_lift_joint" in line] == (
        [] if off is None else missing
    )
    assert off is None or f"{off} of the largest angle" in missing[0]


def test_a_spring_of_a_joint_that_hardly_bends_at_all_still_pulls(tmp_path: Path) -> None:
    """Least squares over a range far beyond M0 gave a negative stiffness, and a damping of nan."""
    model = NOMINAL.with_terms([Term("stiffness_nonlinearity", Site(2), (1.0, 1.0))])
    text, _, _ = patched(tmp_path / "a.xml", mjcf(ARM, UR_JOINTS), model, "tcp")
    spring = mujoco.MjSpec.from_string(text).joint("shoulder_lift_joint_axial_compliance")
    assert spring.stiffness[0] > 0
    assert np.isfinite(spring.damping).all()


def test_a_delayed_actuator_moves_later(tmp_path: Path) -> None:
    model = NOMINAL.with_terms([Term("latency", Site(1), (0.02,))])
    text, _, _ = patched(tmp_path / "a.xml", mjcf(ARM, UR_JOINTS, kp=1e5), model, "tcp")
    compiled = mujoco.MjModel.from_xml_string(text)
    compiled.opt.gravity[:] = 0
    data = mujoco.MjData(compiled)
    data.ctrl[0] = 0.1
    moved = []
    for _ in range(40):
        mujoco.mj_step(compiled, data)
        moved.append(abs(data.joint(UR_JOINTS[0]).qpos[0]) > 1e-9)
    assert 19 <= moved.index(True) <= 23


def test_the_history_of_a_delayed_actuator_is_filled_as_the_change_says(tmp_path: Path) -> None:
    model = NOMINAL.with_terms([Term("latency", Site(1), (0.02,))])
    text, changed, _ = patched(tmp_path / "a.xml", mjcf(ARM, UR_JOINTS, kp=1e5), model, "tcp")
    assert any("delay 0.02 s; after a reset fill its history" in line for line in changed)
    compiled = mujoco.MjModel.from_xml_string(text)
    compiled.opt.gravity[:] = 0
    data = mujoco.MjData(compiled)
    data.qpos[:] = data.ctrl[:] = 1.0
    nsample = mujoco.MjSpec.from_string(text).actuators[0].nsample
    mujoco.mj_initCtrlHistory(compiled, data, 0, None, np.full(nsample, 1.0))
    mujoco.mj_step(compiled, data, nstep=10)
    assert data.qpos[0] == pytest.approx(1.0, abs=1e-9)


def test_a_links_centre_moves_by_its_moment_over_its_mass(tmp_path: Path) -> None:
    """The gravity torques at the joints show the centre of gravity, in both formats."""
    model = NOMINAL.with_terms([Term("link_cog", Site(2), (0.4, -0.2, 0.1))])
    given = {"a.xml": mjcf(ARM, UR_JOINTS), "a.urdf": urdf(ARM, UR_JOINTS)}
    texts = {name: patched(tmp_path / name, text, model, "tcp" if name == "a.xml" else "")[0]
             for name, text in given.items()}  # fmt: skip
    axes = np.eye(3) if ARM.body_axes is None else ARM.body_axes[1]
    in_link = frame_turns(6)[1].inv().apply(axes @ [0.4, -0.2, 0.1])
    after, before = (mujoco.MjModel.from_xml_string(t) for t in (texts["a.xml"], given["a.xml"]))
    moved = after.body("link_2").ipos - before.body("link_2").ipos
    assert np.allclose(moved * before.body("link_2").mass, in_link, rtol=0, atol=1e-5)
    (tmp_path / "b.urdf").write_text(texts["a.urdf"])
    robot = pinocchio.buildModelFromUrdf(str(tmp_path / "b.urdf"))
    link = robot.inertias[2]
    assert np.allclose(link.lever * link.mass, in_link, rtol=0, atol=1e-9)


def test_what_no_format_holds_is_listed_with_what_people_do(tmp_path: Path) -> None:
    wave = Term("transmission_error", Site(1, 2.0), (1e-4, 2e-4))
    model = NOMINAL.with_terms([wave, Term("tool_frame", Site(), (1e-3, 0.0, 0.0, 0.0, 0.0, 0.0))])
    text, _, missing = patched(tmp_path / "a.urdf", urdf(ARM, UR_JOINTS), model, "")
    assert any("transmission_error" in line and "sin" in line for line in missing)
    assert any("- -tcp" in line or "--tcp" in line for line in missing)
    assert "transmission_error" in text


def test_another_arm_is_refused_by_the_joint_that_does_not_agree(tmp_path: Path) -> None:
    (tmp_path / "a.urdf").write_text(urdf(builtin_arm("ur5e"), UR_JOINTS))
    with pytest.raises(InputError, match=r"joint \w+: found its axis .* off the cell's"):
        format_of(tmp_path / "a.urdf").patch(
            tmp_path / "a.urdf", changes_of(NOMINAL), PatchOptions(), []
        )


@pytest.mark.parametrize("n", [1, 3])
def test_an_arm_whose_axes_are_all_parallel_is_refused(tmp_path: Path, n: int) -> None:
    """Its base could be anywhere along them; one joint was patched as if turned."""
    rows = [{"a": 0.4, "alpha": 0.0, "d": 0.1, "mass": 2.0} for _ in range(n)]
    arm, names = arm_from_dh(rows), UR_JOINTS[:n]
    (path := tmp_path / "a.xml").write_text(mjcf(arm, names))
    with pytest.raises(InputError, match=r"a\.xml: joints shoulder_pan.* all parallel, expected"):
        format_of(path).patch(path, changes_of(Model(arm)), PatchOptions(joints=names), [])


@pytest.mark.parametrize(
    ("name", "text", "output"),
    [
        ("a.urdf", "<robot", "broken XML"),
        ("a.urdf", "<sdf/>", "found a <sdf> file"),
        ("a.xml", "<mujoco><worldbody><body/></worldbody></mujoco", "no MJCF that compiles"),
        ("a.urdf", "<robot name='x'><link name='a'/></robot>", "joints: found"),
    ],
)
def test_what_is_no_model_is_one_line(tmp_path: Path, name: str, text: str, output: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=output) as error:
        format_of(tmp_path / name).patch(tmp_path / name, changes_of(NOMINAL), PatchOptions(), [])
    assert "\n" not in str(error.value)


def test_play_of_an_arm_that_stands_straight_up_is_taken_up_against_the_motion(
    tmp_path: Path,
) -> None:
    arm = written_arms()["seven"]
    model = Model(arm.arm, TOOL).with_terms((Term("backlash", Site(1), (0.002,)),))
    written = mjcf(arm.arm, arm.joints, kp=4e4, kv=1200.0, load=4.0)
    text, _, _ = patched(tmp_path / "arm.xml", written, model, "tcp")
    compiled = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(compiled)
    at = [compiled.joint(name).qposadr[0] for name in arm.joints]
    play = compiled.joint(f"{arm.joints[0]}_backlash").qposadr[0]
    rng = np.random.default_rng(3)
    for q in rng.uniform(-1.4, 1.4, (4, 7)):
        approach = rng.choice([-1.0, 1.0], 7)
        mujoco.mj_resetData(compiled, data)
        begin = q - 0.08 * approach
        data.qpos[at], data.ctrl[:] = begin, begin
        mujoco.mj_step(compiled, data, nstep=500)
        for s in np.linspace(0, 1, 2000):
            data.ctrl[:] = begin + (q - begin) * s**3 * (10 - 15 * s + 6 * s * s)
            mujoco.mj_step(compiled, data)
        mujoco.mj_step(compiled, data, nstep=3000)
        assert data.qpos[play] == pytest.approx(-0.001 * approach[0], rel=0.02)
