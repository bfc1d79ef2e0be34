"""MJCF of users: joints with ref, other actuators, masses elsewhere, names and files."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from mjcf_pose import tcp_in_base
from scipy.spatial.transform import Rotation

from benchmarks.patch.arms import BASE_TURN, UR_JOINTS, mjcf, numbers, urdf
from gapbridge.bridge.patch import Patched, PatchOptions, changes_of, format_of
from gapbridge.core.arm import builtin_arm
from gapbridge.core.effects import Site, Term
from gapbridge.core.errors import InputError
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


@pytest.mark.parametrize(
    ("changed", "phrase"),
    [
        (r'\1pos="nan 0 0"', "pos: found nan 0 0, expected finite numbers"),
        (r'\1pos="inf 0 0"', "pos: found inf 0 0, expected finite numbers"),
    ],
)
def test_a_body_at_no_place_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str, phrase: str
) -> None:
    monkeypatch.chdir(tmp_path)
    text = re.sub(r'(<body name="[^"]*" )pos="[^"]*"', changed, mjcf(ARM, UR_JOINTS), count=1)
    with pytest.raises(InputError, match=rf"arm\.xml: body '\w+': {phrase}"):
        patched(tmp_path / "arm.xml", text, OFFSET, PatchOptions())
    assert [path.name for path in tmp_path.iterdir()] == ["arm.xml"]  # no MUJOCO_LOG.TXT


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
    assert np.allclose(tcp_in_base(given, Q), before, rtol=0, atol=SIX_DIGITS)
    found = patched(tmp_path / "a.xml", given, model, PatchOptions(tcp="tcp"))
    expected = model.predict(Q[None]).position[0]
    assert np.allclose(tcp_in_base(found.text, Q), expected, rtol=0, atol=SIX_DIGITS)


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
    off = np.linalg.norm(tcp_in_base(found.text, Q, held=True) - deflected)
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


INERTIA = NOMINAL.with_terms([
    Term("link_inertia", Site(3), (0.25,)), Term("link_cog", Site(3), (0.4, -0.2, 0.1)),
])  # fmt: skip


def composite(text: str, *names: str) -> tuple[float, np.ndarray]:
    """Return the mass (kg) and first moment (kg m) in world of bodies of an MJCF model."""
    compiled = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    ids = [compiled.body(name).id for name in names]
    mass = compiled.body_mass[ids]
    return float(mass.sum()), mass @ data.xipos[ids]


@pytest.mark.parametrize("own", [False, True], ids=["massless", "both"])
def test_a_link_is_all_bodies_that_are_fixed_to_it(tmp_path: Path, own: bool) -> None:
    """Mass and first moment of the link grow as the cell says, wherever its masses are."""
    given = mjcf(ARM, UR_JOINTS)
    inertial = re.search(r'<body name="link_3"[^>]*>(<inertial[^>]*/>)(<joint[^>]*/>)', given)
    assert inertial is not None
    shell = f'<body name="shell" pos="0.1 0 0" euler="1 0 0">{inertial[1]}</body>'
    kept = inertial[1] if own else ""
    given = given.replace(f"{inertial[1]}{inertial[2]}", f"{kept}{inertial[2]}{shell}")
    found = patched(tmp_path / "a.xml", given, INERTIA, PatchOptions())
    before, after = (composite(text, "link_3", "shell") for text in (given, found.text))
    assert after[0] == pytest.approx(1.25 * before[0], rel=1e-5)
    moved = BASE_TURN.inv().apply(after[1] - 1.25 * before[1])
    frame = np.linalg.multi_dot(ARM.link_in_link[:3])[:3, :3]
    axes = np.eye(3) if ARM.body_axes is None else ARM.body_axes[2]
    assert np.allclose(moved, frame @ axes @ [0.4, -0.2, 0.1], rtol=0, atol=1e-4)
    assert not found.unsupported


def test_a_link_that_an_effect_leaves_without_mass_is_one_line(tmp_path: Path) -> None:
    model = NOMINAL.with_terms([Term("link_inertia", Site(3), (-1.0,))])
    with pytest.raises(InputError, match=r"^[^\n]*effects the model does not compile [^\n]*link_3"):
        patched(tmp_path / "arm.xml", mjcf(ARM, UR_JOINTS), model, PatchOptions())


def test_a_link_without_mass_is_listed(tmp_path: Path) -> None:
    """MuJoCo takes such a link only if something is fixed to it, as here the load."""
    model = NOMINAL.with_terms([Term("link_inertia", Site(6), (0.25,))])
    given = {
        "a.xml": re.sub(r'(<body name="link_6"[^>]*>)<inertial[^>]*/>', r"\1",
                        mjcf(ARM, UR_JOINTS, load=4.0)),
        "a.urdf": re.sub(r'(<link name="link_6">)\s*<inertial>.*?</inertial>', r"\1",
                         urdf(ARM, UR_JOINTS), flags=re.DOTALL),
    }  # fmt: skip
    for name, text in given.items():
        found = patched(tmp_path / name, text, model, PatchOptions())
        assert [x for x in found.unsupported if "wrist_3_joint" in x and "no mass" in x]
        assert not found.changed


def test_what_is_fixed_to_the_last_link_is_of_it_where_the_cells_mass_has_it(
    tmp_path: Path,
) -> None:
    model = NOMINAL.with_terms([Term("link_inertia", Site(6), (0.25,))])
    given = mjcf(ARM, UR_JOINTS, load=4.0)
    found = patched(tmp_path / "a.xml", given, model, PatchOptions())
    after, before = (mujoco.MjModel.from_xml_string(t) for t in (found.text, given))
    grown = [after.body(i).name for i in range(1, after.nbody)
             if after.body_mass[i] > before.body_mass[i] + 1e-5]  # fmt: skip
    assert grown == ["link_6"]


def test_a_urdfs_link_is_all_links_that_are_fixed_to_it(tmp_path: Path) -> None:
    given = urdf(ARM, UR_JOINTS)
    inertial = re.search(r'<link name="link_3">(.*?)</link>', given, re.DOTALL)
    assert inertial is not None
    shell = (
        '<joint name="fixed" type="fixed"><parent link="link_3"/><child link="shell"/></joint>'
        f'<link name="shell">{inertial[1]}</link></robot>'
    )
    given = given.replace(inertial[0], '<link name="link_3"/>').replace("</robot>", shell)
    found = patched(tmp_path / "a.urdf", given, INERTIA, PatchOptions())
    assert f'<mass value="{1.25 * ARM.mass[2]:.17g}"' in found.text
    assert any("shell: centre of gravity" in line for line in found.changed)


@pytest.mark.filterwarnings("ignore:.*settotalmass.*deprecated")
@pytest.mark.parametrize("option", ['inertiafromgeom="true"', 'settotalmass="30"'])
def test_masses_change_alone_whatever_the_compiler_does_with_them(
    tmp_path: Path, option: str
) -> None:
    model = NOMINAL.with_terms([
        Term("link_inertia", Site(3), (0.25,)), Term("payload", Site(), (0.8,)),
        Term("base_compliance", Site(), (1e-5, 1e-5)),
    ])  # fmt: skip
    given = mjcf(ARM, UR_JOINTS).replace('angle="radian"', f'angle="radian" {option}')
    given = re.sub(r"(<inertial[^>]*/>)(<joint)", r'\1<geom size="0.05" mass="2"/>\2', given)
    given = re.sub(r"(</?)geom([^>]*>)(<joint[^>]*/>)", r"\3\1geom\2", given)
    found = patched(tmp_path / "a.xml", given, model, PatchOptions())
    after, before = (mujoco.MjModel.from_xml_string(t) for t in (found.text, given))
    for i in range(1, before.nbody):
        name = before.body(i).name
        wanted = before.body(i).mass[0] * (1.25 if name == "link_3" else 1.0)
        assert after.body(name).mass[0] == pytest.approx(wanted, rel=1e-5), name
    assert after.body("payload_difference").mass[0] == pytest.approx(0.8, rel=1e-5)
    assert any(option.partition("=")[0] in line for line in found.changed)


def test_bodies_and_joints_of_a_scene_need_no_names(tmp_path: Path) -> None:
    ball = '<body><freejoint/><geom size="0.1"/></body>'
    door = '<body><joint/><geom size="0.1"/></body>'
    own = '<body name="elbow_joint_body"/>'  # as the elbow's body would be named, had it no name
    given = mjcf(ARM, UR_JOINTS).replace("<worldbody>", f"<worldbody>{2 * ball}{2 * door}{own}")
    given = re.sub("<keyframe>.*</keyframe>", "", given.replace(' name="link_3"', ""))
    model = OFFSET.with_terms([Term("backlash", Site(1), (0.002,))])
    found = patched(tmp_path / "a.xml", given, model, PatchOptions(tcp="tcp"))
    expected = OFFSET.predict(Q[None]).position[0]
    assert np.allclose(tcp_in_base(found.text, Q), expected, rtol=0, atol=SIX_DIGITS)


MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
SIDES = ("right", "left", "up", "down", "front", "back")


def white_png() -> bytes:
    """Return a PNG image of one white pixel."""
    text = b"\x89PNG\r\n\x1a\n"
    for kind, data in (
        (b"IHDR", struct.pack(">IIBBBBB", 1, 1, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(b"\0\xff\xff\xff")),
        (b"IEND", b""),
    ):
        text += struct.pack(">I", len(data)) + kind + data
        text += struct.pack(">I", zlib.crc32(kind + data))
    return text


@pytest.mark.parametrize(
    ("folders", "assets"),
    [
        ("", '<mesh file="in/a.obj"/><texture type="2d" file="b.png"/>'),
        ('assetdir="in"', '<mesh file="a.obj"/><texture type="2d" file="c.png"/>'),
        ('meshdir="in"', '<mesh file="a.obj"/><texture type="2d" file="b.png"/>'),
        ('texturedir="in"', '<mesh file="in/a.obj"/><texture type="2d" file="c.png"/>'),
        ("", '<texture type="cube" ' + " ".join(f'file{s}="b.png"' for s in SIDES) + "/>"),
    ],
    ids=["none", "assetdir", "meshdir", "texturedir", "cube"],
)
def test_a_model_in_another_folder_finds_its_files(
    tmp_path: Path, folders: str, assets: str
) -> None:
    (tmp_path / "model" / "in").mkdir(parents=True)
    (tmp_path / "out").mkdir()
    (tmp_path / "model" / "in" / "a.obj").write_text(MESH)
    for image in ("b.png", "in/c.png"):
        (tmp_path / "model" / image).write_bytes(white_png())
    assets = assets.replace("<texture", '<texture name="t"').replace("<mesh", '<mesh name="m"')
    given = mjcf(ARM, UR_JOINTS).replace(
        '<compiler angle="radian"/>',
        f'<compiler angle="radian" {folders}/><asset>{assets}</asset>',
    )
    options = PatchOptions(folder=tmp_path / "out")
    found = patched(tmp_path / "model" / "a.xml", given, OFFSET, options)
    (tmp_path / "out" / "b.xml").write_text(found.text)
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "b.xml")).ntex == 1


def contacts(text: str, q: np.ndarray) -> set[tuple[str, ...]]:
    """Return the names of the links that touch each other at ``q`` (6,)."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    for name, angle in zip(UR_JOINTS, q, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_forward(model, data)
    link = [model.body(model.body_weldid[body]).name for body in model.geom_bodyid]
    return {tuple(sorted((link[c.geom1], link[c.geom2]))) for c in data.contact[: data.ncon]}


@pytest.mark.parametrize("unfiltered", [False, True])
def test_links_that_touch_across_a_flexible_link_still_do_not_collide(
    tmp_path: Path, unfiltered: bool
) -> None:
    geom = '<geom size="0.35" mass="0"/>'
    given = re.sub(r"(<joint[^>]*/>)", rf"\1{geom}<body>{geom}</body>", mjcf(ARM, UR_JOINTS))
    if unfiltered:
        flag = '<option><flag filterparent="disable"/></option>'
        given = given.replace("<worldbody>", f"{flag}<worldbody>")
    model = NOMINAL.with_terms([
        Term("link_flexibility", Site(2), (2e-5,)), Term("base_compliance", Site(), (1e-5, 1e-5)),
    ])  # fmt: skip
    found = patched(tmp_path / "a.xml", given, model, PatchOptions())
    assert contacts(found.text, Q) == contacts(given, Q)
    assert (("link_2", "link_3") in contacts(given, Q)) is unfiltered


def test_keyframes_hold_velocities_and_activations_of_what_they_belong_to(tmp_path: Path) -> None:
    given = mjcf(ARM, UR_JOINTS, kp=2000.0).replace("</actuator>", (
        '<general name="own" joint="wrist_3_joint" dyntype="filter" dynprm="0.1"/></actuator>'
    ))  # fmt: skip
    key = '<key name="home" qpos="0 1 2 3 4 5" qvel="0 1 2 3 4 5" ctrl="0 1 2 3 4 5 6" act="0.5"/>'
    given = re.sub("<keyframe>.*</keyframe>", f"<keyframe>{key}</keyframe>", given)
    model = NOMINAL.with_terms([
        Term("tracking_lag", Site(3), (0.04,)), Term("axial_compliance", Site(2), (1e-5,)),
    ])  # fmt: skip
    found = mujoco.MjModel.from_xml_string(
        patched(tmp_path / "a.xml", given, model, PatchOptions()).text
    )
    data = mujoco.MjData(found)
    mujoco.mj_resetDataKeyframe(found, data, 0)
    for i, name in enumerate(UR_JOINTS):
        joint = found.joint(name)
        assert (data.qpos[joint.qposadr[0]], data.qvel[joint.dofadr[0]]) == (i, i), name
    # the servo starts at its control, not at zero, from where the arm would jump
    assert data.act[found.actuator_actadr[found.actuator("drive_elbow_joint").id]] == 2.0
    assert data.act[found.actuator_actadr[found.actuator("own").id]] == 0.5
