"""Corrected setpoints: the predicted real pose is the wanted one, or the residual says so."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_equilibrium import SEVEN

from core.arm import arm_from_dh, builtin_arm
from core.compensation import TOLERANCE, Compensator, correct
from core.loads import Loads
from core.model import Model
from core.rotation import rotation_matrix, rotation_vector


def model_of(n, rng, softness=5e-6):
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = rotation_matrix(rng.normal(size=3)), rng.uniform(-0.2, 0.2, 3)
    arm = builtin_arm("ur10e") if n == 6 else arm_from_dh(SEVEN)
    model = Model(arm, tool, payload_mass=6.0, payload_cog=np.array([0.02, 0.0, 0.08]))
    return model.with_compliance(rng.uniform(0, 2, n) * softness, rng.uniform(0, 2, n) * softness)


def loads_of(rng, rows=1):
    return Loads(rng.uniform(0, 10, rows), rng.uniform(-0.1, 0.1, (rows, 3)),
                 rng.normal(size=(rows, 6)) * [40, 40, 40, 5, 5, 5])  # fmt: skip


def distance(model, result, q, loads):
    """Return how far the predicted poses of the setpoints are from the wanted ones, m and rad."""
    wanted, real = model.rigid_pose(q), model.predict(result.q, loads)
    turn = rotation_vector(real.rotation @ np.swapaxes(wanted.rotation, 1, 2))
    return np.linalg.norm(real.position - wanted.position, axis=1), np.linalg.norm(turn, axis=1)


@pytest.mark.parametrize("n", [6, 7])
@given(seed=st.integers(0, 2**31))
@settings(max_examples=100, deadline=None)
def test_the_predicted_pose_of_a_reached_setpoint_is_the_wanted_one(n, seed):
    rng = np.random.default_rng(seed)
    model, q, loads = model_of(n, rng), rng.uniform(-np.pi, np.pi, (3, n)), loads_of(rng, 3)
    result = correct(model, q, loads)
    shift, turn = distance(model, result, q, loads)
    reached = result.residual < TOLERANCE
    assert (shift[reached] < 1e-8).all()
    assert (turn[reached] < 1e-8).all()
    # honest: what is told is what is left, the rotation counted at a lever of half a metre
    left = np.hypot(shift, 0.5 * turn)
    np.testing.assert_allclose(result.residual, left, atol=2e-9, rtol=1e-3)
    assert np.isfinite(result.q).all()


@pytest.mark.parametrize("n", [6, 7])
def test_nearly_every_random_pose_is_reached(n):
    rng = np.random.default_rng(n)
    model, q, loads = model_of(n, rng), rng.uniform(-np.pi, np.pi, (400, n)), loads_of(rng, 400)
    result = correct(model, q, loads)
    assert (result.residual < TOLERANCE).mean() > 0.97
    assert np.median(result.steps) <= 4


@pytest.mark.parametrize("n", [6, 7])
def test_without_compliance_there_is_no_offset(n):
    rng = np.random.default_rng(1)
    model, q = model_of(n, rng, 0.0), rng.uniform(-3, 3, (20, n))
    result = correct(model, q, loads_of(rng, 20))
    np.testing.assert_allclose(result.q, q, atol=1e-14)
    np.testing.assert_allclose(result.offset_in_base, 0, atol=1e-14)
    assert result.residual.max() < TOLERANCE


@pytest.mark.parametrize("n", [6, 7])
def test_the_offset_is_the_rigid_poses_difference(n):
    rng = np.random.default_rng(2)
    model, q = model_of(n, rng), rng.uniform(-2, 2, (10, n))
    result = correct(model, q, loads_of(rng, 10))
    there, here = model.rigid_pose(result.q), model.rigid_pose(q)
    np.testing.assert_allclose(
        result.offset_in_base[:, :3], there.position - here.position, atol=1e-12
    )
    np.testing.assert_allclose(
        result.offset_in_base[:, 3:],
        rotation_vector(there.rotation @ np.swapaxes(here.rotation, 1, 2)), atol=1e-12,
    )  # fmt: skip
    assert np.abs(result.offset_in_base[:, :3]).max() > 1e-4


# a UR's wrist, elbow and shoulder singularities; a seven-joint arm stretched out
SINGULAR = {
    "wrist": [0.3, -1.2, 1.3, -0.7, 0.0, 0.4],
    "elbow": [0.3, -1.2, 0.0, -0.7, 0.8, 0.4],
    "all zero": [0.0] * 6,
    "upright": [0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0],
    "seven stretched": [0.0] * 7,
}


@pytest.mark.parametrize("name", SINGULAR)
@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-7, 1e-4, 1e-2])
def test_near_singularities_setpoints_stay_finite_and_close_and_the_residual_honest(name, away):
    rng = np.random.default_rng(3)
    at = np.array(SINGULAR[name])
    model, loads = model_of(len(at), rng), loads_of(rng, 1)
    q = (at + away * rng.normal(size=len(at)))[None]
    result = correct(model, q, loads)
    assert np.isfinite(result.q).all()
    assert np.isfinite(result.offset_in_base).all()
    # never worse than doing nothing
    untouched, untouched_turn = distance(model, correct(model.without_terms(), q), q, loads)
    shift, turn = distance(model, result, q, loads)
    left = np.hypot(shift, 0.5 * turn)
    assert left <= np.hypot(untouched, 0.5 * untouched_turn) + 1e-12
    np.testing.assert_allclose(result.residual, left, atol=2e-9, rtol=1e-3)


def test_a_redundant_arm_takes_a_short_way():
    rng = np.random.default_rng(4)
    model, q = model_of(7, rng), np.full((1, 7), 0.6)
    result = correct(model, q)
    form = model.linear_form(result.q)
    along = np.linalg.svd(form.jacobian[0])[2][-1]  # the arm's self-motion
    assert abs(along @ (result.q - q)[0]) < 1e-3 * np.linalg.norm(result.q - q)


def test_an_arm_without_equilibrium_is_told_by_an_infinite_residual():
    model = Model(arm_from_dh(SEVEN), payload_mass=14.0).with_compliance([0.5] * 7, [0.5] * 7)
    q = np.full((1, 7), 0.8)
    result = correct(model, q)
    assert result.residual[0] == np.inf
    np.testing.assert_array_equal(result.q, q)


@pytest.mark.parametrize("n", [6, 7])
def test_live_correction_along_a_path_is_what_all_rows_at_once_are(n):
    rng = np.random.default_rng(5)
    model = model_of(n, rng)
    q = np.linspace(np.full(n, 1.2), np.full(n, 1.6), 50)
    live = Compensator(model)
    path = np.array([live.correct(row).q for row in q])
    for r in (0, 25, 49):
        cold = Compensator(model).correct(q[r])
        real = model.predict(np.vstack([path[r], cold.q])).position
        np.testing.assert_allclose(real[0], real[1], atol=1e-8)
    # smooth: the offset's slope does not jump between neighbours
    assert np.abs(np.diff(path - q, 2, axis=0)).max() < 5e-5


def test_a_live_correction_after_a_failure_starts_afresh():
    rng = np.random.default_rng(6)
    model = model_of(6, rng)
    live, q = Compensator(model), np.full(6, 0.7)
    good = live.correct(q)
    live.correct(q, Loads(payload_mass=np.array([1e9])))
    again = live.correct(q)
    assert again.residual < TOLERANCE
    np.testing.assert_allclose(again.q, good.q, atol=1e-8)
