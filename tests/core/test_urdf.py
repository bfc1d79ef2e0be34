"""URDF files: any axes, fixed joints, side branches, and every mistake in one line."""

import numpy as np
import pinocchio as pin
import pytest
from oracle import rigid

from gapbridge.core.errors import ArmError
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.urdf import arm_from_urdf

INERTIA = '<inertia ixx="0.02" iyy="0.03" izz="0.01" ixy="0.001" ixz="0.002" iyz="-0.001"/>'
AXES = ("0 0 1", "0 1 0", "0 -1 0", "1 0 0", "0.6 0 0.8", "0 0 -1", "-1 0 0")


def link(name, mass=0.0, xyz="0 0 0", rpy="0 0 0"):
    return (f'<link name="{name}"><inertial><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<mass value="{mass}"/>{INERTIA}</inertial></link>')  # fmt: skip


def joint(name, kind, parent, child, xyz="0 0 0", rpy="0 0 0", axis="0 0 1", limit=""):
    return (f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}</joint>')  # fmt: skip


LIMIT = '<limit lower="-2" upper="2.5" velocity="3" effort="100"/>'


def branched(n):
    """Return an arm of n joints with odd axes, a fixed joint in mid-chain and two side branches."""
    rng = np.random.default_rng(n)
    parts = [link("base", 9.0)]
    before = "base"
    for i in range(1, n + 1):
        x, y, z = rng.uniform(-0.3, 0.3, 3)
        roll, pitch, yaw = rng.uniform(-1, 1, 3)
        if i == 3:
            parts += [
                link("spacer", 1.1, "0 0.1 0"),
                joint("bolted", "fixed", before, "spacer", "0.1 0 0.05", "0.2 -0.3 0.4"),
            ]
            before = "spacer"
        parts += [link(f"l{i}", 6.0 / i, f"{x / 3} 0.02 {z / 3}", "0.1 0.2 0.3"),
                  joint(f"j{i}", "revolute", before, f"l{i}", f"{x} {y} {z}",
                        f"{roll} {pitch} {yaw}", AXES[i - 1], LIMIT)]  # fmt: skip
        before = f"l{i}"
    parts += [
        link("cover", 0.7, "0.01 0.02 0.03"),
        link("lamp", 0.2, "0 0 0.1"),
        joint("snap", "fixed", "l2", "cover", "0.1 0.1 0", "1 0 0"),
        joint("clip", "fixed", "cover", "lamp", "0 0.1 0", "0 1 0"),
        link("flange"),
        joint("end", "fixed", before, "flange", "0 0 0.1", "0 0.5 0"),
    ]
    return f'<robot name="odd"><!-- arm -->{"".join(parts)}</robot>'


@pytest.fixture(params=[6, 7])
def pair(request, tmp_path):
    text = branched(request.param)
    path = tmp_path / "odd.urdf"
    path.write_text(text)
    return arm_from_urdf(path, "flange"), pin.buildModelFromXML(text)


def test_frames_jacobian_and_moments_are_pinocchios(pair):
    arm, oracle = pair
    rng = np.random.default_rng(1)
    tcp, gravity = np.array([0.02, 0.03, 0.15]), np.array([0.5, 1.0, -9.7])
    tool = np.eye(4)
    tool[:3, 3] = tcp
    model = Model(arm, tool, gravity=gravity)
    count = 20
    q = rng.uniform(-3, 3, (count, arm.n))
    loads = Loads(rng.uniform(0, 8, count), rng.uniform(-0.1, 0.1, (count, 3)),
                  rng.normal(size=(count, 6)) * 20)  # fmt: skip
    form, poses = model.linear_form(q, loads), model.rigid_pose(q)
    for r in range(count):
        flange = rigid.flange_pose(oracle, q[r])
        np.testing.assert_allclose(poses.position[r], flange.act(tcp), atol=1e-9)
        np.testing.assert_allclose(poses.rotation[r], flange.rotation, atol=1e-9)
        J = rigid.tool_jacobian(oracle, q[r], tcp)
        np.testing.assert_allclose(form.jacobian[r], J, atol=1e-9)
        M = rigid.joint_moments(oracle, q[r], gravity, tcp, loads.wrench[r],
                                loads.payload_mass[r], loads.payload_cog[r])  # fmt: skip
        np.testing.assert_allclose(form.moment[r], M, atol=1e-9)


def test_masses_and_inertias_of_what_is_bolted_on_are_pinocchios(pair):
    arm, oracle = pair
    for i, body in enumerate(list(oracle.inertias)[1:]):
        assert arm.mass[i] == pytest.approx(body.mass, abs=1e-12)
        # the same centre and tensor, seen from frames whose z is the axis
        assert np.linalg.norm(arm.cog[i]) == pytest.approx(np.linalg.norm(body.lever), abs=1e-12)
        np.testing.assert_allclose(
            np.linalg.eigvalsh(arm.inertia[i]), np.linalg.eigvalsh(body.inertia), atol=1e-12
        )


def test_limits_and_names_come_along(pair):
    arm, _ = pair
    assert arm.joint_names == tuple(f"j{i + 1}" for i in range(arm.n))
    np.testing.assert_array_equal(arm.limits.lower, -2)
    np.testing.assert_array_equal(arm.limits.upper, 2.5)
    np.testing.assert_array_equal(arm.limits.velocity, 3)
    np.testing.assert_array_equal(arm.limits.effort, 100)


def write(tmp_path, *parts):
    path = tmp_path / "arm.urdf"
    path.write_text(f'<robot name="a">{"".join(parts)}</robot>')
    return path


def test_a_continuous_joint_and_one_without_limits_turn_freely(tmp_path):
    path = write(tmp_path, link("b"), link("l1"), link("l2"),
                 joint("j1", "continuous", "b", "l1", limit=LIMIT),
                 joint("j2", "revolute", "l1", "l2"))  # fmt: skip
    arm = arm_from_urdf(path)
    assert arm.limits.upper.tolist() == [np.inf, np.inf]
    assert arm.limits.velocity.tolist() == [3, np.inf]


def test_the_only_end_with_most_joints_is_the_flange(tmp_path):
    path = write(tmp_path, link("b"), link("l1"), link("l2"), link("lamp"),
                 joint("j1", "revolute", "b", "l1"), joint("j2", "revolute", "l1", "l2"),
                 joint("clip", "fixed", "b", "lamp"))  # fmt: skip
    assert arm_from_urdf(path).n == 2


def test_a_tip_halfway_leaves_the_rest_as_dead_weight(tmp_path):
    path = write(tmp_path, link("b"), link("l1", 1.0), link("l2", 2.0, "0.1 0 0"),
                 joint("j1", "revolute", "b", "l1"),
                 joint("j2", "revolute", "l1", "l2", "0.5 0 0"))  # fmt: skip
    arm = arm_from_urdf(path, "l1")
    assert arm.n == 1
    assert arm.mass[0] == pytest.approx(3)
    np.testing.assert_allclose(arm.cog[0], [2 * 0.6 / 3, 0, 0], atol=1e-15)


TWO = (link("b"), link("l1"), joint("j1", "revolute", "b", "l1"))


@pytest.mark.parametrize(
    ("parts", "tip", "message"),
    [
        (TWO, "hand", r"robot.tip: found 'hand', expected a link of the file: b, l1"),
        ((link("b"), link("l1"), joint("j1", "prismatic", "b", "l1")), None,
         r"joint 'j1': found type 'prismatic', expected revolute, continuous or fixed"),
        ((link("b"), link("l1"), joint("j1", "fixed", "b", "l1")), None,
         r"found no revolute joint on the way to the tip"),
        ((*TWO, link("r"), joint("j2", "revolute", "b", "r")), None,
         r"found 2 ends \(l1, r\), expected robot.tip to name the flange link"),
        ((link("b"), link("l1"), joint("j1", "revolute", "b", "l1", xyz="0 zero 0")), None,
         r"joint 'j1': xyz: found '0 zero 0', expected 3 finite number\(s\)"),
        ((link("b"), link("l1"), joint("j1", "revolute", "b", "l1", axis="0 1")), None,
         r"joint 'j1': xyz: found '0 1', expected 3"),
        ((link("b"), link("l1", "nan"), joint("j1", "revolute", "b", "l1")), None,
         r"link 'l1': value: found 'nan', expected 1"),
        ((link("b"), '<joint name="j" type="fixed"/>'), None,
         r"joint 'j': found no parent or child link"),
        ((*TWO, joint("j2", "revolute", "b", "l1")), None,
         r"joint 'j2': found child link 'l1', expected one that joint 'j1' does not move already"),
    ],
)  # fmt: skip
def test_a_mistake_is_reported_in_one_line(tmp_path, parts, tip, message):
    path = write(tmp_path, *parts)
    with pytest.raises(ArmError, match=message) as caught:
        arm_from_urdf(path, tip)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_what_is_no_urdf_is_reported(tmp_path):
    with pytest.raises(ArmError, match="file not found"):
        arm_from_urdf(tmp_path / "none.urdf")
    with pytest.raises(ArmError, match="cannot be read"):
        arm_from_urdf(tmp_path)
    path = tmp_path / "x.urdf"
    for text, message in (("<robot", "broken XML"), ("<sdf/>", "found a <sdf> file")):
        path.write_text(text)
        with pytest.raises(ArmError, match=message):
            arm_from_urdf(path)
    path.write_bytes(bytes(range(256)))
    with pytest.raises(ArmError, match="found bytes that are no text, expected a URDF"):
        arm_from_urdf(path)
    path.write_text('<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include/></robot>')
    with pytest.raises(ArmError, match=r"found xacro macros.*ros2 run xacro xacro x\.urdf"):
        arm_from_urdf(path)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ((link("b"), link("l1"), joint("j1", "revolute", "b", "l1", axis="0 0 0")),
         "joint 'j1': axis xyz: found '0 0 0', expected a direction"),
        ((link("b"), joint("j1", "revolute", "b", "l1")),
         "joint 'j1': found link 'l1', expected one that the file has"),
        ((link("b"), link("l1"), joint("j1", "revolute", "b", "l1",
          limit='<limit lower="low" upper="1"/>')),
         "joint 'j1': limit: lower: found 'low', expected 1 finite number"),
        ((link("b"), link("l1"), joint("j1", "revolute", "b", "l1",
          limit='<limit lower="-1_0" upper="1"/>')),
         "joint 'j1': limit: lower: found '-1_0', expected 1 finite number"),
        ((link("b"), link("l1"), joint("j1", "revolute", "b", "l1",
          limit='<limit velocity="nan"/>')),
         "joint 'j1': limit: velocity: found 'nan', expected 1 finite number"),
        ((link("b"), link("l1"), joint("j1", "revolute", "b", "l1",
          limit='<limit velocity="-1"/>')),
         "joint 'j1': limit: velocity: found -1, expected 0 or more"),
        ((link("b"), link("l1"), joint("j1", "revolute", "b", "l1", axis="0 0 1e-200")),
         "joint 'j1': axis xyz: found '0 0 1e-200', expected a direction"),
        ((link("b"), link("l1"), joint("j1", "revolute", "b", "l1", axis="0 0 1e200")),
         "joint 'j1': axis xyz: found '0 0 1e.200', expected a direction"),
        ((link("b"), '''<link name="l1"><inertial><mass value="1"/>
          <inertia ixx="-0.06"/></inertial></link>''', joint("j1", "revolute", "b", "l1")),
         "link 'l1': ixx: found -0.06, expected 0 or more"),
        ((*TWO, link("b")), "link 'b': found twice, expected once"),
        ((*TWO, link("l2"), joint("j1", "revolute", "l1", "l2")),
         "joint 'j1': found twice, expected once"),
        ((*TWO, joint("j2", "revolute", "l1", "b")),
         "link 'l1': found a closed loop, expected a tree"),
        ((link("b"), joint("j1", "revolute", "b", "b")),
         "link 'b': found a closed loop, expected a tree"),
        ((), "found no links, expected those of an arm"),
    ],
)  # fmt: skip
def test_a_zero_axis_a_missing_link_and_a_bad_limit_are_reported(tmp_path, parts, message):
    with pytest.raises(ArmError, match=message):
        arm_from_urdf(write(tmp_path, *parts))
