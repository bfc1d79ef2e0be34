"""Frames and Jacobians against Pinocchio."""

import numpy as np
import pytest
from oracle import rigid
from test_equilibrium import SEVEN

from gapbridge.core.arm import arm_from_dh, builtin_arm, builtin_names, builtin_rows
from gapbridge.core.errors import InputError
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

TCP = np.array([0.03, -0.05, 0.18])
ROWS = {name: builtin_rows(name)["dh"] for name in builtin_names()} | {"seven": SEVEN}


def model_of(name):
    tool = np.eye(4)
    tool[:3, 3] = TCP
    return Model(arm_from_dh(SEVEN) if name == "seven" else builtin_arm(name), tool)


@pytest.mark.parametrize("name", ROWS)
def test_tool_poses_are_pinocchios(name):
    model, oracle = model_of(name), rigid.from_dh(ROWS[name])
    q = np.random.default_rng(1).uniform(-2 * np.pi, 2 * np.pi, (30, model.arm.n))
    poses = model.rigid_pose(q)
    for r in range(len(q)):
        flange = rigid.flange_pose(oracle, q[r])
        np.testing.assert_allclose(poses.position[r], flange.act(TCP), atol=1e-12)
        np.testing.assert_allclose(poses.rotation[r], flange.rotation, atol=1e-12)


@pytest.mark.parametrize("name", ROWS)
def test_the_jacobian_is_pinocchios(name):
    model, oracle = model_of(name), rigid.from_dh(ROWS[name])
    q = np.random.default_rng(2).uniform(-2 * np.pi, 2 * np.pi, (30, model.arm.n))
    J = model.linear_form(q).jacobian
    for r in range(len(q)):
        np.testing.assert_allclose(J[r], rigid.tool_jacobian(oracle, q[r], TCP), atol=1e-9)


def test_the_jacobian_of_a_deflected_arm_is_its_finite_difference_where_bending_stays():
    # without gravity and masses the shape does not change along with the joints
    model = Model(arm_from_dh(SEVEN), gravity=np.zeros(3))
    q, step = np.full((1, 7), 0.4), 1e-6
    J = model.linear_form(q).jacobian[0]
    for i in range(7):
        d = np.eye(7)[i] * step
        change = model.predict(q + d).position[0] - model.predict(q - d).position[0]
        np.testing.assert_allclose(change / (2 * step), J[:3, i], atol=1e-8)


@pytest.mark.parametrize(
    ("q", "loads", "found"),
    [
        ((5, 5), Loads(), r"q: found an array \(5, 5\), expected \(5, 6\)"),
        ((5, 7), Loads(), r"q: found"),
        ((5, 6), Loads(payload_mass=np.ones(1)), r"payload_mass: found an array \(1,\)"),
        ((5, 6), Loads(payload_cog=np.ones(3)), r"payload_cog: .* expected \(5, 3\)"),
        ((5, 6), Loads(wrench=np.ones((5, 3))), r"wrench: .* expected \(5, 6\)"),
    ],
)
def test_arrays_of_other_shapes_are_refused(q, loads, found):
    """The kernels would read beyond them."""
    model = Model(builtin_arm("ur10e"))
    for job in (model.predict, model.linear_form):
        with pytest.raises(InputError, match=found):
            job(np.zeros(q), loads)
