"""``gapbridge patch`` as users call it: ties, stand-ins, bounds, other folders, models' classes."""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from cli_runs import Answer, gapbridge

from benchmarks.patch.arms import UR_JOINTS, mjcf, urdf
from gapbridge.core.arm import builtin_arm

mujoco = pytest.importorskip("mujoco")

ARM = builtin_arm("ur10e")
CELL = """
robot: {model: ur10e}
tool: {tcp: {xyz: [0, 0, 0.1], rpy: [0, 0, 0]}}
metrology: {registered: true, sigma: 2.0e-5}
compliance: {axial: [0, 2.0e-5, 0, 0, 0, 0], radial: [0, 0, 0, 0, 0, 0]}
effects:
  - {effect: joint_offset, joint: 3, parameters: {value: 0.004}}
  - {effect: coulomb_friction, joint: 1, parameters: {value: 5.0}}
  - {effect: latency, joint: 4, parameters: {value: 0.02}}
  - {effect: viscous_friction, joint: 2, parameters: {value: 3.0}, stand_in: true}
provenance:
  causes:
    - {effect: axial_compliance, joints: [2], channel: position, parameters: [{name: axial_compliance_2, value: 2.0e-5, std: 1.0e-6, unit: rad/Nm}], indistinguishable_from: [link_flexibility]}
    - {effect: joint_offset, joints: [3], channel: position, parameters: [{name: joint_offset_3, value: 0.004, std: 1.0e-4, unit: rad}]}
    - {effect: latency, joints: [4], channel: tracking, parameters: [{name: latency_4, value: 0.02, std: 0.001, unit: s}], indistinguishable_from: [tracking_lag]}
"""  # noqa: E501
CLASSES = '<default><joint damping="7" range="-1 1" frictionloss="2" armature="3"/></default>'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "cell.yaml").write_text(CELL)
    (tmp_path / "arm.xml").write_text(mjcf(ARM, UR_JOINTS, kp=1e4))
    (tmp_path / "arm.urdf").write_text(urdf(ARM, UR_JOINTS))
    return tmp_path


def patch(folder: Path, *arguments: str) -> Answer:
    with contextlib.chdir(folder):
        return gapbridge("patch", *arguments, "--cell", "cell.yaml")


@pytest.mark.parametrize("model", ["arm.xml", "arm.urdf"])
def test_a_tie_is_a_comment_with_both_candidates(folder: Path, model: str) -> None:
    done = patch(folder, model, "--out", f"out{Path(model).suffix}")
    assert done.code == 0, done.err
    text = (folder / f"out{Path(model).suffix}").read_text()
    comment = text[text.index("<!--") : text.index("-->", text.index("Patched"))]
    tied = [line for line in comment.splitlines() if "tie:" in line]
    assert len(tied) == 2
    assert "axial_compliance_2 = 2e-05" in tied[0]
    assert "link_flexibility" in tied[0]
    assert "latency_4" in tied[1]
    assert "tracking_lag" in tied[1]
    assert done.out.count("tie:") == 2


@pytest.mark.parametrize("model", ["arm.xml", "arm.urdf"])
def test_a_patched_model_is_patched_again_only_by_a_cell_that_adds_to_it(
    folder: Path, model: str
) -> None:
    once, twice = (f"{name}{Path(model).suffix}" for name in ("once", "twice"))
    (cell := folder / "cell.yaml").write_text(CELL.replace("{value: 0.004}", "{value: 0.0004}"))
    assert patch(folder, model, "--out", once).code == 0
    done = patch(folder, once, "--out", twice)
    assert done.code == 2
    assert f"{once}: found a model that was patched already, expected the original" in done.err
    cell.write_text(cell.read_text() + "  files: [{role: sim, name: simulated.csv}]\n")
    done = patch(folder, once, "--out", twice)
    if model.endswith("xml"):  # its springs have the names of those that would be added
        assert done.code == 2
        assert "joint: found 'shoulder_lift_joint_axial_compliance' already" in done.err
    else:
        assert done.code == 0, done.err


def test_names_that_are_not_utf8_are_escaped_or_refused(folder: Path) -> None:
    cell, model = (folder / os.fsdecode(name) for name in (b"c\xff.yaml", b"m\xff.xml"))
    (folder / "cell.yaml").rename(cell)
    (folder / "arm.xml").rename(model)
    for given in ("arm.urdf", model):
        out = folder / f"out{Path(given).suffix}"
        done = gapbridge("patch", folder / given, "--cell", cell, "--out", out)
        if given != model:
            assert done.code == 0, done.err
            assert r"cell: c\udcff.yaml" in out.read_text(encoding="utf-8")
    assert done.code == 2  # MuJoCo takes no such name
    assert "found a name that is not UTF-8, expected one that is" in done.err


def test_what_was_not_accused_is_never_written(folder: Path) -> None:
    done = patch(folder, "arm.xml", "--out", "out.xml")
    assert "not held: viscous_friction of joint 2: a stand-in, not a confirmed cause" in done.out
    compiled = mujoco.MjModel.from_xml_path(str(folder / "out.xml"))
    assert np.ravel(compiled.dof_damping[compiled.joint(UR_JOINTS[1]).dofadr[0]])[0] == 0


def loaded(path: Path) -> ModuleType:
    from importlib.util import module_from_spec, spec_from_file_location

    spec = spec_from_file_location("bounds", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Number:
    """What ``mujoco.sysid.Parameter`` gives a modifier."""

    def __init__(self, value: float) -> None:
        self.value = np.array([value])


def test_bounds_free_what_was_accused_alone(folder: Path) -> None:
    import yaml

    done = patch(folder, "arm.xml", "--out", "out.xml", "--parameters", "bounds.yaml")
    assert done.code == 0, done.err
    found = yaml.safe_load((folder / "bounds.yaml").read_text())
    free = {name for name, state in found.items() if not state["frozen"]}
    assert free == {"axial_compliance_2", "joint_offset_3", "latency_4"}
    assert found["coulomb_friction_1"]["frozen"]
    assert not any("viscous" in name for name in found)
    own = found["axial_compliance_2"]
    assert own["min_value"] == pytest.approx([1.7e-5])
    assert own["max_value"] == pytest.approx([2.3e-5])
    assert own["nominal"] == pytest.approx([2e-5])


def test_modifiers_bring_the_patched_model_to_any_value_within_bounds(folder: Path) -> None:
    done = patch(folder, "arm.xml", "--out", "out.xml", "--parameters", "bounds.py")
    assert done.code == 0, done.err
    module = loaded(folder / "bounds.py")

    def model(**values: float) -> Any:
        spec = mujoco.MjSpec.from_file(str(folder / "out.xml"))
        for name, value in values.items():
            module.modifier(name)(spec, Number(value))
        return spec.compile()

    as_it_is = model(axial_compliance_2=2e-5, joint_offset_3=0.004, latency_4=0.02)
    written = mujoco.MjModel.from_xml_path(str(folder / "out.xml"))
    assert np.allclose(as_it_is.jnt_stiffness, written.jnt_stiffness)
    assert np.allclose(as_it_is.body_quat, written.body_quat)
    soft = model(axial_compliance_2=2.2e-5)
    spring = soft.joint(f"{UR_JOINTS[1]}_axial_compliance").id
    assert np.ravel(soft.jnt_stiffness[spring])[0] == pytest.approx(1 / 2.2e-5, rel=2e-3)
    turned = model(joint_offset_3=0.0043)
    wanted = CELL.replace("value: 0.004}}", "value: 0.0043}}")
    (folder / "cell.yaml").write_text(wanted)
    patch(folder, "arm.xml", "--out", "other.xml")
    other = mujoco.MjModel.from_xml_path(str(folder / "other.xml"))
    assert np.allclose(turned.body_quat, other.body_quat, atol=1e-7)
    late = model(latency_4=0.023)
    drive = late.actuator(f"drive_{UR_JOINTS[3]}").id
    assert late.actuator_delay[drive] == pytest.approx(0.023)


def test_a_spring_is_the_inverse_of_its_compliance_within_wide_bounds(folder: Path) -> None:
    wide = CELL.replace("std: 1.0e-6, unit: rad/Nm", "std: 8.0e-6, unit: rad/Nm")
    droop = "  - {effect: servo_droop, joint: 3, parameters: {value: 5.0e-5}}\nprovenance:"
    cause = (
        "    - {effect: servo_droop, joints: [3], channel: tracking, parameters: "
        "[{name: servo_droop_3, value: 5.0e-5, std: 1.0e-5, unit: rad/Nm}]}\n"
    )
    wide = wide.replace("provenance:", droop) + cause
    (folder / "cell.yaml").write_text(wide)
    done = patch(folder, "arm.xml", "--out", "out.xml", "--parameters", "bounds.py")
    assert done.code == 0, done.err
    module = loaded(folder / "bounds.py")
    assert module.BOUNDS["axial_compliance_2"][:3] == pytest.approx((2e-5, 2e-6, 4.4e-5))

    for name, given, attributes in (
        ("axial_compliance_2", "axial: [0, 2.0e-5", ("jnt_stiffness", "dof_damping")),
        ("servo_droop_3", "servo_droop, joint: 3, parameters: {value: 5.0e-5",
         ("actuator_gainprm", "actuator_biasprm")),
    ):  # fmt: skip
        _, lower, upper, free = module.BOUNDS[name]
        assert free
        for x in np.linspace(lower, upper, 7).tolist():
            spec = mujoco.MjSpec.from_file(str(folder / "out.xml"))
            module.modifier(name)(spec, Number(x))
            found = spec.compile()
            assert given in wide
            (folder / "cell.yaml").write_text(wide.replace(given, given[:-6] + f"{x:.17f}"))
            assert patch(folder, "arm.xml", "--out", "other.xml").code == 0
            wanted = mujoco.MjModel.from_xml_path(str(folder / "other.xml"))
            for attribute in attributes:
                assert np.allclose(
                    getattr(found, attribute), getattr(wanted, attribute), rtol=1e-3
                ), (attribute, x)


def test_mujocos_own_sysid_reads_the_bounds(folder: Path) -> None:
    sysid = pytest.importorskip("mujoco.sysid")
    if not hasattr(sysid, "ParameterDict"):
        pytest.skip("mujoco[sysid] is not installed")
    patch(folder, "arm.xml", "--out", "out.xml", "--parameters", "bounds.py")
    patch(folder, "arm.xml", "--out", "out.xml", "--parameters", "bounds.yaml")
    parameters = loaded(folder / "bounds.py").parameters()
    read = sysid.ParameterDict.load_from_disk(folder / "bounds.yaml")
    assert parameters.size == read.size == 3
    assert np.allclose(parameters.get_bounds(), read.get_bounds())
    spec = mujoco.MjSpec.from_file(str(folder / "out.xml"))
    sysid.apply_param_modifiers(parameters, spec)


@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        (["arm.urdf", "--out", "out.urdf", "--parameters", "bounds.py"], "expected an MJCF"),
        (["arm.xml", "--out", "out.xml", "--parameters", "bounds.txt"], "expected .py or"),
        (["arm.xml", "--out", "out.xml", "--parameters", "arm.xml"], "expected .py or"),
        (["arm.xml", "--out", "out.yaml"], "out.yaml: found .yaml, expected .xml or .mjcf"),
        (["arm.urdf", "--out", "out.xml"], "out.xml: found .xml, expected .urdf"),
        (["arm.xml", "--out", "out.xml", "--tcp", "tpc"], "--tcp: found tpc"),  # it stays nominal
        (["arm.urdf", "--out", "out.urdf", "--tcp", "tpc"], "--tcp: found tpc"),
        (["arm.xml", "--out", "out.xml", "--load", "nope"], "--load: found nope"),
        (["arm.urdf", "--out", "out.urdf", "--load", "link"], "--load: found with arm.urdf"),
    ],
)
def test_options_that_cannot_be_used_are_one_line(
    folder: Path, arguments: list[str], output: str
) -> None:
    done = patch(folder, *arguments)
    assert done.code == 2
    assert output in done.err
    assert len(done.err.strip().splitlines()) == 1
    assert not (folder / arguments[2]).exists()


def test_a_urdf_whose_links_are_a_loop_is_one_line(folder: Path) -> None:
    text = (folder / "arm.urdf").read_text()
    loop = '<joint name="back" type="fixed"><parent link="{}"/><child link="{}"/></joint></robot>'
    parents, children = (re.findall(rf'{tag} link="(\w+)"', text) for tag in ("parent", "child"))
    root = next(link for link in parents if link not in children)
    (folder / "arm.urdf").write_text(text.replace("</robot>", loop.format(children[-1], root)))
    done = patch(folder, "arm.urdf", "--out", "out.urdf")
    assert done.code == 2
    assert done.err.startswith("error: arm.urdf: link ")
    assert done.err.endswith(": found a closed loop, expected a tree\n")


def test_further_joints_take_nothing_from_a_models_classes(folder: Path) -> None:
    text = (folder / "arm.xml").read_text().replace("<worldbody>", f"{CLASSES}<worldbody>")
    (folder / "arm.xml").write_text(text)
    done = patch(folder, "arm.xml", "--out", "out.xml")
    assert done.code == 0, done.err
    compiled = mujoco.MjModel.from_xml_path(str(folder / "out.xml"))
    spring = compiled.joint(f"{UR_JOINTS[1]}_axial_compliance")
    assert compiled.jnt_limited[spring.id] == 0
    assert compiled.dof_frictionloss[spring.dofadr[0]] == 0
    own = compiled.joint(UR_JOINTS[1])
    assert compiled.jnt_limited[own.id] == 1
    assert compiled.dof_frictionloss[own.dofadr[0]] == 2


def test_meshes_are_found_from_another_folder(folder: Path) -> None:
    (folder / "meshes").mkdir()
    (folder / "meshes" / "box.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    text = (folder / "arm.xml").read_text().replace(
        '<compiler angle="radian"/>',
        '<compiler angle="radian" meshdir="meshes"/>'
        '<asset><mesh name="box" file="box.obj"/></asset>',
    )  # fmt: skip
    (folder / "arm.xml").write_text(text)
    (folder / "deep" / "er").mkdir(parents=True)
    done = patch(folder, "arm.xml", "--out", "deep/er/out.xml")
    assert done.code == 0, done.err
    assert mujoco.MjModel.from_xml_path(str(folder / "deep" / "er" / "out.xml")).nmesh == 1
