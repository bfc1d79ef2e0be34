"""Arms from tables and DH rows: where the numbers go, and every mistake in one line."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from core.arm import JointLimits, arm_from_dh, builtin_arm, builtin_names, builtin_rows
from core.errors import ArmError
from core.model import Model

# flange of a UR at zero, by its drawing: stretched out along -x, at height d1 - d5 in z
REACH = {"ur3e": 0.45675, "ur5e": 0.8172, "ur10e": 1.18425, "ur16e": 0.8384, "ur20": 1.5907,
         "ur30": 1.1407}  # fmt: skip


@pytest.mark.parametrize("name", builtin_names())
def test_a_built_in_arm_is_whole(name):
    arm = builtin_arm(name)
    assert arm.name == name
    assert arm.n == 6
    assert (arm.mass > 0).all()
    assert np.isfinite(arm.cog).all()
    assert np.abs(arm.cog).max() < 1
    assert (arm.limits.lower < 0).all()
    assert (arm.limits.upper > 0).all()
    assert (arm.limits.velocity > 1).all()
    assert (arm.limits.effort > 5).all()
    assert 2 < arm.payload < 40
    table = builtin_rows(name)
    assert table["name"] == name


@pytest.mark.parametrize("name", REACH)
def test_a_built_in_arm_at_zero_stands_as_its_drawing(name):
    rows = builtin_rows(name)["dh"]
    pose = Model(builtin_arm(name)).rigid_pose(np.zeros((1, 6)))
    d = [row["d"] for row in rows]
    expected = [-REACH[name], -(d[3] + d[5]), d[0] - d[4]]
    np.testing.assert_allclose(pose.position[0], expected, atol=1e-4)


def test_an_unknown_arm_names_the_nearest():
    with pytest.raises(ArmError, match=r"robot.model: found 'ur16f', .*did you mean 'ur16e'\?"):
        builtin_arm("ur16f")
    with pytest.raises(ArmError, match=r"found 'zzz', expected one of .*ur10e"):
        builtin_arm("zzz")


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


def test_mass_and_cog_may_be_left_out():
    arm = arm_from_dh([{"a": 0.3, "alpha": 0, "d": 0}], "stick")
    assert arm.name == "stick"
    assert arm.mass.tolist() == [0]
    assert arm.payload == np.inf
    assert arm.limits.upper.tolist() == [np.inf]


def test_limits_given_are_kept():
    limits = JointLimits(*(np.array([v]) for v in (-1.0, 1.0, 2.0, 3.0)))
    assert arm_from_dh([{"a": 0, "alpha": 0, "d": 0}], limits=limits).limits.effort[0] == 3


GOOD = {"a": 0.3, "alpha": 0, "d": 0}


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "robot.dh: found no rows"),
        ([GOOD, {"a": 0, "d": 0}], r"robot.dh row 2: alpha: found nothing, expected a number"),
        ([{**GOOD, "d": "long"}], r"row 1: d: found 'long', expected a number"),
        ([{**GOOD, "a": float("nan")}], r"row 1: a: found nan, expected a finite number"),
        ([{**GOOD, "mass": -1}], r"row 1: mass: found -1, expected 0 or more kg"),
        ([{**GOOD, "cog": [0, 0]}], r"row 1: cog: found \[0, 0\], expected three numbers"),
        ([{**GOOD, "cog": [0, 0, float("inf")]}], "row 1: cog: found"),
        ([{**GOOD, "cog": ["a", 0, 0]}], "row 1: cog: found"),
        ([{**GOOD, "offset": [1]}], r"row 1: offset: found \[1\], expected a number"),
    ],
)
def test_a_mistake_in_dh_rows_is_told(rows, message):
    with pytest.raises(ArmError, match=message) as caught:
        arm_from_dh(rows)
    assert "\n" not in str(caught.value)


def test_a_factory_calibration_is_added_to_the_rows():
    delta = {
        "delta_theta": [1e-3, -2e-3, 3e-3, 1e-4, 2e-4, 3e-4],
        "delta_a": [1e-4, 2e-4, -3e-4, 4e-5, 0, 0],
        "delta_d": [1e-4, 0.3, -0.2, -0.1, 1e-5, 0],
        "delta_alpha": [1e-3, -1e-3, 2e-3, 1e-4, 0, 0],
    }
    rows = builtin_rows("ur5e")["dh"]
    for i, row in enumerate(rows):
        for key, own in (("theta", "offset"), ("a", "a"), ("d", "d"), ("alpha", "alpha")):
            row[own] = row.get(own, 0.0) + delta[f"delta_{key}"][i]
    q = np.random.default_rng(0).uniform(-3, 3, (5, 6))
    calibrated = Model(builtin_arm("ur5e", delta)).rigid_pose(q).position
    np.testing.assert_allclose(calibrated, Model(arm_from_dh(rows)).rigid_pose(q).position)
    assert np.abs(calibrated - Model(builtin_arm("ur5e")).rigid_pose(q).position).max() > 1e-4


def test_a_calibration_of_another_length_is_told():
    with pytest.raises(ArmError, match=r"delta_a: found 5 values, expected 6"):
        builtin_arm("ur5e", {"delta_a": [0.0] * 5})
