"""The layer that is written over a USD stage, as pxr composes it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.patch.arms import BASE_AT, BASE_TURN, UR_JOINTS, frame_turns, slid
from gapbridge.bridge.patch import PatchOptions, changes_of, format_of
from gapbridge.core.arm import Arm, builtin_arm
from gapbridge.core.effects import Site, Term
from gapbridge.core.errors import InputError
from gapbridge.core.model import Model

pxr = pytest.importorskip("pxr")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics  # noqa: E402

ARM = builtin_arm("ur10e")
TOOL = np.eye(4)
TOOL[2, 3] = 0.1
NOMINAL = Model(ARM, TOOL)
SINGLE = 2e-6  # m: joints' places are single precision there
SOME_Q = np.random.default_rng(5).uniform(-2, 2, (6, 6))
CENTIMETRES = 0.01
GEOMETRY = (
    Term("joint_offset", Site(3), (0.004,)),
    Term("link_geometry", Site(2), (2e-3, 1e-3, 3e-3, 2e-3)),
    Term("link_geometry", Site(4), (-1e-3, 2e-3, 1e-3)),
    Term("tool_frame", Site(), (1e-3, 2e-3, -1e-3, 0.0, 0.0, 0.0)),
)


def write_stage(path: Path, arm: Arm, unit: float, nested: bool) -> None:
    """Write an arm as a stage: bodies beside each other or one in the other, at zero angles."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/arm").GetPrim())
    UsdPhysics.Scene.Define(stage, "/scene")
    turns = frame_turns(arm.n)
    base = np.eye(4)
    base[:3, :3], base[:3, 3] = BASE_TURN.as_matrix(), BASE_AT
    place(stage, "/arm/base", base, unit)
    parent, parent_path, joint_in_parent = base, "/arm/base", arm.link_in_link[0]
    for i, name in enumerate(UR_JOINTS):
        turned = np.eye(4)
        turned[:3, :3] = turns[i].as_matrix()
        world = parent @ joint_in_parent @ turned
        link = f"{parent_path}/link_{i + 1}" if nested else f"/arm/link_{i + 1}"
        body = place(stage, link, world, unit)
        UsdPhysics.MassAPI.Apply(body.GetPrim()).CreateMassAttr().Set(float(arm.mass[i]))
        joint = UsdPhysics.RevoluteJoint.Define(stage, f"/arm/{name}")
        joint.CreateAxisAttr().Set("Z")
        joint.CreateBody0Rel().SetTargets([parent_path])
        joint.CreateBody1Rel().SetTargets([link])
        local(joint, 0, joint_in_parent, unit)
        local(joint, 1, np.linalg.inv(turned), unit)
        parent, parent_path = world, link
        joint_in_parent = np.linalg.inv(turned) @ arm.link_in_link[i + 1]
    place(stage, f"{parent_path}/tcp", parent @ joint_in_parent @ TOOL, unit)
    stage.Save()


def place(stage: Any, path: str, world: np.ndarray, unit: float) -> Any:
    xform = UsdGeom.Xform.Define(stage, path)
    above = np.array(UsdGeom.XformCache().GetParentToWorldTransform(xform.GetPrim())).T
    scaled = world.copy()
    scaled[:3, 3] /= unit
    xform.AddTransformOp().Set(Gf.Matrix4d((np.linalg.inv(above) @ scaled).T.tolist()))
    return xform


def local(joint: Any, side: int, frame: np.ndarray, unit: float) -> None:
    x, y, z, w = Rotation.from_matrix(frame[:3, :3]).as_quat()
    rotation = joint.CreateLocalRot0Attr() if side == 0 else joint.CreateLocalRot1Attr()
    position = joint.CreateLocalPos0Attr() if side == 0 else joint.CreateLocalPos1Attr()
    rotation.Set(Gf.Quatf(w, x, y, z))
    position.Set(Gf.Vec3f(*(frame[:3, 3] / unit)))


def joint_frame(joint: Any, side: int, unit: float) -> np.ndarray:
    rotation = joint.GetLocalRot0Attr() if side == 0 else joint.GetLocalRot1Attr()
    position = joint.GetLocalPos0Attr() if side == 0 else joint.GetLocalPos1Attr()
    quat, found = rotation.Get(), np.eye(4)
    found[:3, :3] = Rotation.from_quat([*quat.GetImaginary(), quat.GetReal()]).as_matrix()
    found[:3, 3] = np.array(position.Get()) * unit
    return found


def tcp_in_base(stage: Any, q: np.ndarray, unit: float) -> np.ndarray:
    """Return the TCP in base: joints by their frames, the tool by its place in the last body."""
    frame, angles = np.eye(4), dict(zip(UR_JOINTS, q, strict=True))
    last = ""
    for name in UR_JOINTS:
        joint = UsdPhysics.RevoluteJoint(stage.GetPrimAtPath(f"/arm/{name}"))
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec([0, 0, angles[name]]).as_matrix()
        frame = frame @ joint_frame(joint, 0, unit) @ turn
        frame = frame @ np.linalg.inv(joint_frame(joint, 1, unit))
        last = str(joint.GetBody1Rel().GetTargets()[0])
    cache = UsdGeom.XformCache()
    tool = stage.GetPrimAtPath(f"{last}/tcp")
    inside = cache.GetLocalToWorldTransform(tool) * cache.GetLocalToWorldTransform(
        stage.GetPrimAtPath(last)).GetInverse()  # fmt: skip
    matrix = np.array(inside).T
    matrix[:3, 3] *= unit
    return (frame @ matrix)[:3, 3]


def patched(folder: Path, model: Model, unit: float = 1.0, nested: bool = False) -> Any:
    write_stage(folder / "a.usda", ARM, unit, nested)
    options = PatchOptions(tcp="tcp", folder=folder)
    found = format_of(folder / "a.usda").patch(folder / "a.usda", changes_of(model), options,
                                               ["a note"])  # fmt: skip
    (folder / "b.usda").write_text(found.text)
    return Usd.Stage.Open(str(folder / "b.usda")), found


@pytest.mark.parametrize("unit", [1.0, CENTIMETRES])
@pytest.mark.parametrize("nested", [False, True])
def test_a_patched_stage_is_where_predict_is(tmp_path: Path, unit: float, nested: bool) -> None:
    model = NOMINAL.with_terms(GEOMETRY)
    before = tmp_path / "a.usda"
    stage, found = patched(tmp_path, model, unit, nested)
    given = before.read_text()
    for q in SOME_Q:
        expected = model.predict(q[None]).position[0]
        assert np.allclose(tcp_in_base(stage, q, unit), expected, rtol=0, atol=SINGLE)
        nominal = NOMINAL.predict(q[None]).position[0]
        below = Usd.Stage.Open(str(before))
        assert np.allclose(tcp_in_base(below, q, unit), nominal, rtol=0, atol=SINGLE)
    assert before.read_text() == given
    assert not found.unsupported


@pytest.mark.parametrize("nested", [False, True])
def test_bodies_stand_where_the_joints_have_them(tmp_path: Path, nested: bool) -> None:
    model = NOMINAL.with_terms(GEOMETRY)
    stage, _ = patched(tmp_path, model, nested=nested)
    tool = next(p for p in stage.Traverse() if p.GetName() == "tcp")
    at = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(tool).ExtractTranslation())
    expected = model.predict(np.zeros((1, 6))).position[0]
    assert np.allclose(BASE_TURN.inv().apply(at - BASE_AT), expected, rtol=0, atol=1e-5)


def test_a_patch_from_another_folder_warns_of_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (elsewhere := tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(elsewhere)
    stage, _ = patched(tmp_path, NOMINAL.with_terms(GEOMETRY))
    assert stage.GetPrimAtPath("/arm/link_6")
    assert capfd.readouterr().err == ""


def test_a_tcp_that_the_stage_lacks_is_refused_also_where_it_stays(tmp_path: Path) -> None:
    write_stage(tmp_path / "a.usda", ARM, 1.0, nested=False)
    kind, options = format_of(tmp_path / "a.usda"), PatchOptions(tcp="tpc")
    with pytest.raises(InputError, match="--tcp: found tpc"):
        kind.patch(tmp_path / "a.usda", changes_of(NOMINAL), options, [])


def test_the_layer_holds_overs_alone_where_nothing_is_added(tmp_path: Path) -> None:
    model = NOMINAL.with_terms([*GEOMETRY, Term("coulomb_friction", Site(2), (4.0,))])
    _, found = patched(tmp_path, model)
    assert "over " in found.text
    assert "def " not in found.text
    assert "@./a.usda@" in found.text
    assert "a note" in found.text


@pytest.mark.parametrize("unit", [1.0, CENTIMETRES])
def test_springs_are_at_the_cells_joint_where_the_stages_is_elsewhere_on_its_axis(
    tmp_path: Path, unit: float
) -> None:
    write_stage(tmp_path / "a.usda", slid(ARM, np.full(6, 0.176)), unit, nested=False)
    model = NOMINAL.with_terms([Term("radial_compliance", Site(2), (2e-5,))])
    options = PatchOptions(folder=tmp_path)
    found = format_of(tmp_path / "a.usda").patch(tmp_path / "a.usda", changes_of(model), options,
                                                 [])  # fmt: skip
    (tmp_path / "b.usda").write_text(found.text)
    stage = Usd.Stage.Open(str(tmp_path / "b.usda"))
    cells_joint = (ARM.link_in_link[0] @ ARM.link_in_link[1])[:3, 3]
    for label in ("radial_x", "radial_y"):
        spring = UsdPhysics.RevoluteJoint(stage.GetPrimAtPath(f"/arm/{UR_JOINTS[1]}_{label}"))
        for side, targets in enumerate((spring.GetBody0Rel(), spring.GetBody1Rel())):
            prim = stage.GetPrimAtPath(targets.GetTargets()[0])
            body = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim)).T
            body[:3, 3] *= unit
            at = (body @ joint_frame(spring, side, unit))[:3, 3]
            assert np.allclose(BASE_TURN.inv().apply(at - BASE_AT), cells_joint, rtol=0, atol=1e-5)


def test_units_of_friction_damping_and_drives(tmp_path: Path) -> None:
    model = NOMINAL.with_terms([
        Term("coulomb_friction", Site(1), (3.0,)), Term("viscous_friction", Site(2), (5.0,)),
        Term("rotor_inertia", Site(3), (0.4,)), Term("servo_droop", Site(4), (1e-4,)),
        Term("axial_compliance", Site(2), (2e-5,)), Term("backlash", Site(6), (0.002,)),
        Term("link_inertia", Site(2), (0.1,)), Term("latency", Site(4), (0.02,)),
    ])  # fmt: skip
    stage, found = patched(tmp_path, model)

    def of(joint: int, name: str) -> float:
        prim = stage.GetPrimAtPath(f"/arm/{UR_JOINTS[joint - 1]}")
        return float(prim.GetAttribute(name).Get())

    assert of(1, "newton:friction") == pytest.approx(3.0)
    assert of(2, "newton:damping") == pytest.approx(5.0 * np.pi / 180)  # Nm s/deg
    assert of(3, "physxJointAxis:angular:armature") == pytest.approx(0.4)
    assert of(4, "drive:angular:physics:stiffness") == pytest.approx(1e4 * np.pi / 180)
    spring = stage.GetPrimAtPath(f"/arm/{UR_JOINTS[1]}_axial_compliance")
    stiffness = spring.GetAttribute("drive:angular:physics:stiffness").Get()
    assert stiffness == pytest.approx(5e4 * np.pi / 180)
    play = UsdPhysics.RevoluteJoint(stage.GetPrimAtPath(f"/arm/{UR_JOINTS[5]}_backlash"))
    assert play.GetUpperLimitAttr().Get() == pytest.approx(np.degrees(0.001))
    assert str(play.GetBody1Rel().GetTargets()[0]) == "/arm/link_6"
    own = UsdPhysics.RevoluteJoint(stage.GetPrimAtPath(f"/arm/{UR_JOINTS[5]}"))
    assert own.GetBody1Rel().GetTargets() == play.GetBody0Rel().GetTargets()
    mass = UsdPhysics.MassAPI(stage.GetPrimAtPath("/arm/link_2")).GetMassAttr().Get()
    assert mass == pytest.approx(1.1 * ARM.mass[1], rel=1e-5)
    assert any("delay" in line for line in found.unsupported)


@pytest.mark.parametrize(("own", "ends"), [(0.0, (0, 1)), (2.0, (0, 1)), (2.0, (1, 0))])
def test_a_link_is_all_bodies_that_are_fixed_to_it(
    tmp_path: Path, own: float, ends: tuple[int, int]
) -> None:
    write_stage(tmp_path / "a.usda", ARM, 1.0, nested=False)
    given = Usd.Stage.Open(str(tmp_path / "a.usda"))
    link = UsdGeom.XformCache().GetLocalToWorldTransform(given.GetPrimAtPath("/arm/link_3"))
    place(given, "/arm/shell", np.array(link).T, 1.0)
    fixed = UsdPhysics.FixedJoint.Define(given, "/arm/shell_joint")
    bodies = ["/arm/link_3", "/arm/shell"]  # either way round: the joint joins them all the same
    fixed.CreateBody0Rel().SetTargets([bodies[ends[0]]])
    fixed.CreateBody1Rel().SetTargets([bodies[ends[1]]])
    for path, mass in (("/arm/link_3", own), ("/arm/shell", 3.0)):
        UsdPhysics.MassAPI.Apply(given.GetPrimAtPath(path)).CreateMassAttr().Set(mass)
    given.Save()
    model = NOMINAL.with_terms([
        Term("link_inertia", Site(3), (0.25,)), Term("link_cog", Site(3), (0.4, -0.2, 0.1)),
        Term("joint_offset", Site(2), (0.004,)),
    ])  # fmt: skip
    kind, options = format_of(tmp_path / "a.usda"), PatchOptions(folder=tmp_path)
    found = kind.patch(tmp_path / "a.usda", changes_of(model), options, [])
    (tmp_path / "b.usda").write_text(found.text)
    stage = Usd.Stage.Open(str(tmp_path / "b.usda"))
    moment = 0.0
    for path, mass in (("/arm/link_3", own), ("/arm/shell", 3.0)):
        body = UsdPhysics.MassAPI(stage.GetPrimAtPath(path))
        assert body.GetMassAttr().Get() == pytest.approx(1.25 * mass)
        if mass:
            moment += 1.25 * mass * np.linalg.norm(body.GetCenterOfMassAttr().Get())
    assert moment == pytest.approx(np.linalg.norm([0.4, -0.2, 0.1]), rel=1e-5)
    cache = UsdGeom.XformCache()
    link, shell = (np.array(cache.GetLocalToWorldTransform(stage.GetPrimAtPath(path)))
                   for path in ("/arm/link_3", "/arm/shell"))  # fmt: skip
    assert np.abs(link - np.array(UsdGeom.XformCache().GetLocalToWorldTransform(
        given.GetPrimAtPath("/arm/link_3")))).max() > 1e-3  # fmt: skip
    assert shell == pytest.approx(link, abs=1e-6)
    assert not found.unsupported


def test_what_is_no_usd_is_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.usda").write_text("nothing")
    with pytest.raises(InputError, match="found no USD that opens, expected a stage") as error:
        format_of(tmp_path / "a.usda").patch(
            tmp_path / "a.usda", changes_of(NOMINAL), PatchOptions(), []
        )
    assert "\n" not in str(error.value)
    assert capfd.readouterr().err == ""  # USD itself warns


def two_robots_in(folder: Path) -> Path:
    """Write a stage that has the arm twice, as /left and as /right, and return it."""
    write_stage(folder / "one.usda", ARM, 1.0, nested=False)
    path = folder / "two.usda"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    for name, y in (("left", 0.0), ("right", 3.0)):
        robot = UsdGeom.Xform.Define(stage, f"/{name}")
        robot.GetPrim().GetReferences().AddReference("./one.usda")
        robot.AddTranslateOp().Set((0, y, 0))
    stage.Save()
    return path


@pytest.mark.parametrize("joints", [(), UR_JOINTS])
def test_joints_of_two_robots_are_refused_with_their_paths(
    tmp_path: Path, joints: tuple[str, ...]
) -> None:
    path = two_robots_in(tmp_path)
    with pytest.raises(InputError, match="with --joints") as error:
        format_of(path).patch(path, changes_of(NOMINAL), PatchOptions(joints), [])
    assert f"found {UR_JOINTS[0]} as /left/{UR_JOINTS[0]} and /right/{UR_JOINTS[0]}" in str(
        error.value
    )


def test_one_of_two_robots_is_patched_by_its_joints_paths(tmp_path: Path) -> None:
    path, out = two_robots_in(tmp_path), tmp_path / "out.usda"
    terms = (Term("joint_offset", Site(3), (0.004,)), Term("axial_compliance", Site(2), (2e-5,)))
    options = PatchOptions(tuple(f"/left/{name}" for name in UR_JOINTS))
    done = format_of(path).patch(path, changes_of(NOMINAL.with_terms(terms)), options, [])
    out.write_text(done.text)
    before, after = Usd.Stage.Open(str(path)), Usd.Stage.Open(str(out))
    spring = after.GetPrimAtPath(f"/left/{UR_JOINTS[1]}_axial_compliance")
    assert spring.IsA(UsdPhysics.RevoluteJoint)
    for robot, changed in (("left", True), ("right", False)):
        elbow = f"/{robot}/{UR_JOINTS[2]}"
        old, new = (
            UsdPhysics.Joint.Get(stage, elbow).GetLocalRot0Attr().Get() for stage in (before, after)
        )
        assert (old != new) == changed


def test_a_tcp_of_two_robots_is_refused_with_its_paths(tmp_path: Path) -> None:
    path = two_robots_in(tmp_path)
    options = PatchOptions(tuple(f"/left/{name}" for name in UR_JOINTS), tcp="tcp")
    with pytest.raises(InputError, match=r"--tcp: found tcp as /left/\S*tcp and /right/\S*tcp,"):
        format_of(path).patch(path, changes_of(NOMINAL), options, [])


def test_a_path_names_a_joint_whose_name_is_its_own(tmp_path: Path) -> None:
    path = tmp_path / "arm.usda"
    write_stage(path, ARM, 1.0, nested=False)
    changes = changes_of(NOMINAL.with_terms((Term("joint_offset", Site(3), (0.004,)),)))
    paths = PatchOptions(tuple(f"/arm/{name}" for name in UR_JOINTS))
    texts = {
        format_of(path).patch(path, changes, options, []).text
        for options in (PatchOptions(), paths)
    }
    assert len(texts) == 1


@pytest.mark.parametrize("touching", [False, True])
def test_links_that_touch_at_a_flexible_joint_still_do_not_collide(
    tmp_path: Path, touching: bool
) -> None:
    write_stage(tmp_path / "a.usda", ARM, 1.0, nested=False)
    given = Usd.Stage.Open(str(tmp_path / "a.usda"))
    joint = UsdPhysics.Joint(given.GetPrimAtPath(f"/arm/{UR_JOINTS[2]}"))
    joint.CreateCollisionEnabledAttr().Set(touching)
    given.Save()
    model = NOMINAL.with_terms([Term("axial_compliance", Site(3), (1e-5,))])
    found = format_of(tmp_path / "a.usda").patch(
        tmp_path / "a.usda", changes_of(model), PatchOptions(folder=tmp_path), []
    )
    (tmp_path / "b.usda").write_text(found.text)
    stage = Usd.Stage.Open(str(tmp_path / "b.usda"))
    pairs = UsdPhysics.FilteredPairsAPI(stage.GetPrimAtPath("/arm/link_3"))
    filtered = [str(path) for path in pairs.GetFilteredPairsRel().GetTargets()]
    assert filtered == ([] if touching else ["/arm/link_2"])


@pytest.mark.parametrize("on_top", [False, True])
def test_a_joint_that_has_friction_has_the_cells_instead_or_both_where_it_was_simulated(
    tmp_path: Path, on_top: bool
) -> None:
    write_stage(tmp_path / "a.usda", ARM, 1.0, nested=False)
    given = Usd.Stage.Open(str(tmp_path / "a.usda"))
    joint = given.GetPrimAtPath(f"/arm/{UR_JOINTS[0]}")
    joint.CreateAttribute("newton:friction", Sdf.ValueTypeNames.Float).Set(10.0)
    given.Save()
    found = format_of(tmp_path / "a.usda").patch(
        tmp_path / "a.usda",
        changes_of(NOMINAL.with_terms([Term("coulomb_friction", Site(1), (3.0,))])),
        PatchOptions(folder=tmp_path, on_top=on_top),
        [],
    )
    (tmp_path / "b.usda").write_text(found.text)
    stage = Usd.Stage.Open(str(tmp_path / "b.usda"))
    friction = stage.GetPrimAtPath(f"/arm/{UR_JOINTS[0]}").GetAttribute("newton:friction").Get()
    assert friction == pytest.approx(13.0 if on_top else 3.0)
