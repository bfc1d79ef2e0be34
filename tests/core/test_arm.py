"""Arms from DH rows and from the built-in tables: their numbers, and every mistake in one line."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import rigid
from scipy.spatial.transform import Rotation

from gapbridge.core.arm import JointLimits, arm_from_dh, builtin_arm, builtin_names, builtin_rows
from gapbridge.core.errors import ArmError
from gapbridge.core.model import Model

# Universal Robots' published tables: a2, a3, d1, d4, d5, d6 (m), link masses (kg), rated payload
PUBLISHED = {
    "ur3e": ((-0.24355, -0.2132, 0.15185, 0.13105, 0.08535, 0.0921),
             (1.98, 3.4445, 1.437, 0.871, 0.805, 0.261), 3.0),
    "ur5e": ((-0.425, -0.3922, 0.1625, 0.1333, 0.0997, 0.0996),
             (3.761, 8.058, 2.846, 1.37, 1.3, 0.365), 5.0),
    "ur10e": ((-0.6127, -0.57155, 0.1807, 0.17415, 0.11985, 0.11655),
              (7.369, 13.051, 3.989, 2.1, 1.98, 0.615), 12.5),
    "ur16e": ((-0.4784, -0.36, 0.1807, 0.17415, 0.11985, 0.11655),
              (7.369, 10.45, 4.321, 2.18, 2.033, 0.907), 16.0),
    "ur20": ((-0.8620, -0.7287, 0.2363, 0.2010, 0.1593, 0.1543), None, 20.0),
    "ur30": ((-0.6370, -0.5037, 0.2363, 0.2010, 0.1593, 0.1543), None, 30.0),
}  # fmt: skip


@pytest.mark.parametrize("name", PUBLISHED)
def test_built_in_tables_are_the_published_ones(name):
    lengths, masses, payload = PUBLISHED[name]
    table, arm = builtin_rows(name), builtin_arm(name)
    rows = table["dh"]
    found = (rows[1]["a"], rows[2]["a"], rows[0]["d"], rows[3]["d"], rows[4]["d"], rows[5]["d"])
    assert found == lengths
    if masses:
        np.testing.assert_array_equal(arm.mass, masses)
    assert [r["alpha"] for r in rows] == pytest.approx([np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0])
    assert arm.payload == payload
    assert arm.name == name
    assert arm.n == 6


@pytest.mark.parametrize("name", builtin_names())
def test_built_in_arms_have_masses_centres_and_limits(name):
    arm = builtin_arm(name)
    assert (arm.mass > 0).all()
    assert (np.linalg.norm(arm.cog, axis=1) < 1).all()
    assert (arm.limits.lower < arm.limits.upper).all()
    assert np.isfinite(arm.limits.velocity).all()
    assert (arm.limits.effort > 0).all()


def test_the_older_urs_named_in_the_contract_are_there():
    assert set(PUBLISHED) <= set(builtin_names())


def test_an_unknown_arm_is_reported_with_the_nearest_one():
    with pytest.raises(ArmError, match=r"robot.model: found 'ur10ee'.*did you mean 'ur10e'\?"):
        builtin_arm("ur10ee")
    with pytest.raises(ArmError, match="found 'fanuc', expected one of ur"):
        builtin_arm("fanuc")


def test_factory_calibration_is_added_to_the_rows():
    rng = np.random.default_rng(1)
    delta = {f"delta_{k}": rng.normal(size=6) * 1e-3 for k in ("theta", "a", "d", "alpha")}
    rows = [
        row | {"a": row["a"] + delta["delta_a"][i], "d": row["d"] + delta["delta_d"][i],
               "alpha": row["alpha"] + delta["delta_alpha"][i],
               "offset": delta["delta_theta"][i]}
        for i, row in enumerate(builtin_rows("ur5e")["dh"])
    ]  # fmt: skip
    model, oracle = Model(builtin_arm("ur5e", delta)), rigid.from_dh(rows)
    q = rng.uniform(-3, 3, (10, 6))
    poses = model.rigid_pose(q)
    for r in range(10):
        np.testing.assert_allclose(
            poses.position[r], rigid.flange_pose(oracle, q[r]).translation, atol=1e-12
        )
    assert np.abs(poses.position - Model(builtin_arm("ur5e")).rigid_pose(q).position).max() > 1e-3


SMALL, FAR = st.floats(-2e-3, 2e-3), st.floats(-500, 500)


@given(
    deltas=st.lists(SMALL, min_size=24, max_size=24), far=FAR, further=FAR,
    turn=st.floats(-3, 3), seed=st.integers(0, 1000),
)  # fmt: skip
@settings(max_examples=100, deadline=None)
def test_a_calibration_with_far_origins_that_cancel_leaves_every_pose_as_it_is(
    deltas, far, further, turn, seed
):
    theta, a, d, alpha = np.reshape(deltas, (4, 6))
    # as on real arms: origins of joints 3 and 4 far out along the parallel axes, and turned
    d[1:4] += far, further - far, -further
    theta[1:3] += turn, -turn
    rows = [
        row | {"a": row["a"] + a[i], "d": row["d"] + d[i], "alpha": row["alpha"] + alpha[i],
               "offset": theta[i]}
        for i, row in enumerate(builtin_rows("ur10e")["dh"])
    ]  # fmt: skip
    delta = dict(zip(("delta_theta", "delta_a", "delta_d", "delta_alpha"), (theta, a, d, alpha),
                     strict=True))  # fmt: skip
    q = np.random.default_rng(seed).uniform(-3, 3, (5, 6))
    slid, as_given = Model(builtin_arm("ur10e", delta)), Model(arm_from_dh(rows))
    one, other = slid.rigid_pose(q), as_given.rigid_pose(q)
    np.testing.assert_allclose(one.position, other.position, atol=1e-9)
    np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-9)


def test_joints_of_a_calibrated_arm_bend_where_the_metal_is():
    # lines of joints 2 and 3, twisted so that they meet 300 m out; the calibration of no other row
    twist, far = 1e-6, 300.0
    delta = {"delta_d": [0, far, -far, 0, 0, 0], "delta_alpha": [0, twist, -twist, 0, 0, 0]}
    plain, found = builtin_arm("ur10e"), builtin_arm("ur10e", delta)
    assert np.abs(found.link_in_link[:, :3, 3]).max() < 1
    np.testing.assert_allclose(
        found.link_in_link[:, :3, 3], plain.link_in_link[:, :3, 3], atol=2e-3
    )
    np.testing.assert_allclose(found.cog, plain.cog, atol=2e-3)
    q = np.random.default_rng(1).uniform(-2, 2, (20, 6))
    bends = [
        deflected.predict(q).position - deflected.rigid_pose(q).position
        for deflected in (
            Model(arm).with_compliance([1e-5] * 6, [5e-6] * 6) for arm in (plain, found)
        )
    ]
    assert np.abs(bends[0]).max() > 1e-4
    np.testing.assert_allclose(bends[1], bends[0], atol=1e-2 * np.abs(bends[0]).max())


def calibration_of(axes):
    """Return delta_* of a UR10e whose axes 2 to 4 (point, direction) are these at zero.

    DH rows by common normals, as a controller's own calibration writes them.
    """
    rows = builtin_rows("ur10e")["dh"]
    frames = [np.eye(4), *(transform_of(arm_from_dh(rows), k + 1) for k in range(1, 6))]
    x, at = [frames[1][:3, 0]], [frames[1][:3, 3]]  # of DH frames 1, 2, 3, 4
    for (p, z), (r, w) in itertools.pairwise(axes):
        normal = np.cross(z, w)
        normal /= np.linalg.norm(normal) * np.sign(normal @ frames[1][:3, 0])
        # where the common normal meets the second axis: p + s z + t normal = r + u w
        u = np.linalg.solve(np.column_stack([z, normal, -w]), r - p)[2]
        x.append(normal)
        at.append(r + u * w)
    x.append(frames[4][:3, 0])
    at.append(frames[4][:3, 3])
    z = [axis[1] for axis in axes] + [frames[4][:3, 2]]
    delta = {f"delta_{key}": np.zeros(6) for key in ("theta", "a", "d", "alpha")}
    for k in range(3):  # rows 2, 3, 4
        way, row = at[k + 1] - at[k], rows[k + 1]
        turn = np.arctan2(np.cross(x[k], x[k + 1]) @ z[k], x[k] @ x[k + 1])
        twist = np.arctan2(np.cross(z[k], z[k + 1]) @ x[k + 1], z[k] @ z[k + 1])
        delta["delta_theta"][k + 1] = turn
        delta["delta_d"][k + 1] = way @ z[k] - row["d"]
        delta["delta_a"][k + 1] = way @ x[k + 1] - row["a"]
        delta["delta_alpha"][k + 1] = twist - row["alpha"]
    return delta


def test_a_controllers_own_calibration_bends_like_the_arm_that_it_describes():
    plain = builtin_arm("ur10e")
    axes = [(f[:3, 3], f[:3, 2]) for f in (transform_of(plain, k) for k in (2, 3, 4))]
    tilted = Rotation.from_rotvec([1.5e-3, 0, 1e-3]).apply(axes[1][1])  # the elbow's, a little
    delta = calibration_of([axes[0], (axes[1][0], tilted), axes[2]])
    assert np.abs(delta["delta_d"]).max() > 100  # m
    assert np.abs(delta["delta_theta"]).max() > 0.3
    found = builtin_arm("ur10e", delta)
    for k in range(1, 7):
        frame, nominal = transform_of(found, k), transform_of(plain, k)
        np.testing.assert_allclose(frame[:3, 3], nominal[:3, 3], atol=3e-3)
        centre = frame @ np.append(found.cog[k - 1], 1)
        np.testing.assert_allclose(centre, nominal @ np.append(plain.cog[k - 1], 1), atol=1e-9)
    q = np.random.default_rng(1).uniform(-2, 2, (20, 6))
    bends = [
        deflected.predict(q).position - deflected.rigid_pose(q).position
        for deflected in (
            Model(arm).with_compliance([1e-5] * 6, [5e-6] * 6) for arm in (plain, found)
        )
    ]
    assert np.abs(bends[0]).max() > 1e-4
    np.testing.assert_allclose(bends[1], bends[0], atol=2e-2 * np.abs(bends[0]).max())


def transform_of(arm, joints):
    """Return the frame of the last of ``joints`` joints in base, all at zero."""
    return np.linalg.multi_dot([np.eye(4), *arm.link_in_link[:joints]])


def test_factory_calibration_of_another_length_is_reported():
    with pytest.raises(ArmError, match=r"delta_a: found 7 values, expected 6"):
        builtin_arm("ur5e", {"delta_a": [0.0] * 7})


def test_a_calibration_does_not_stick_to_the_built_in_arm():
    before = builtin_arm("ur3e").link_in_link
    builtin_arm("ur3e", {"delta_d": [0.1] * 6})
    np.testing.assert_array_equal(builtin_arm("ur3e").link_in_link, before)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "robot.dh: found no rows"),
        ([{"a": 0, "d": 0}], "robot.dh entry 1.alpha: found nothing, expected a number"),
        ([{"a": 0, "d": 0, "alpha": "long"}], "entry 1.alpha: found 'long', expected a number"),
        ([{"a": 0, "d": 0, "alpha": 0}, {"a": float("nan"), "d": 0, "alpha": 0}],
         "entry 2.a: found nan, expected a finite number"),
        ([{"a": 0, "d": 0, "alpha": 0, "mass": -1}], "entry 1.mass: found -1, expected 0 or more"),
        ([{"a": 0, "d": 0, "alpha": 0, "mass": None}], "entry 1.mass: found nothing"),
        ([{"a": 0, "d": 0, "alpha": 0, "cog": [1, 2]}], r"entry 1.cog: found \[1, 2\]"),
        ([{"a": 0, "d": 0, "alpha": 0, "cog": ["x", 0, 0]}], "entry 1.cog: found"),
        ([{"a": 0, "d": 0, "alpha": 0, "cog": [[1], 0, 0]}], "entry 1.cog: found"),
    ],
)  # fmt: skip
def test_a_mistake_in_dh_rows_is_reported_in_one_line(rows, message):
    with pytest.raises(ArmError, match=message) as caught:
        arm_from_dh(rows)
    assert "\n" not in str(caught.value)


def test_rows_without_masses_make_a_weightless_arm_without_limits():
    arm = arm_from_dh([{"a": 0.3, "d": 0.1, "alpha": 0.2}] * 7)
    assert arm.n == 7
    assert not arm.mass.any()
    assert np.isinf(arm.limits.upper).all()
    assert arm.payload == np.inf
    assert JointLimits.none(7).lower.tolist() == [-np.inf] * 7


def test_dh_rows_place_centres_of_gravity_in_the_rows_frames():
    row = {"a": 0.3, "alpha": 0.7, "d": 0.2, "offset": 0.4, "mass": 2.0, "cog": [0.1, 0.2, 0.3]}
    arm = arm_from_dh([row])
    expected = Rotation.from_euler("x", 0.7).apply([0.1, 0.2, 0.3])
    np.testing.assert_allclose(arm.cog[0] - [0.3, 0, 0.2], expected, atol=1e-15)
    flange = Model(arm).rigid_pose(np.array([[0.5]]))
    turn = Rotation.from_euler("z", 0.9)
    np.testing.assert_allclose(flange.position[0], turn.apply([0.3, 0, 0.2]), atol=1e-15)
    np.testing.assert_allclose(
        flange.rotation[0], (turn * Rotation.from_euler("x", 0.7)).as_matrix(), atol=1e-15
    )


def test_limits_given_are_kept():
    limits = JointLimits(*(np.array([v]) for v in (-1.0, 1.0, 2.0, 3.0)))
    assert arm_from_dh([{"a": 0, "alpha": 0, "d": 0}], limits=limits).limits.effort[0] == 3
