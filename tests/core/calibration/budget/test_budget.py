"""The uncertainty budget against sums worked out by hand, and the sensitivities behind it."""

from dataclasses import replace

import numpy as np
import pytest
from hand_made import hand_made
from scipy.stats import t as student

from gapbridge.core.calibration.budget.budget import budget
from gapbridge.core.calibration.budget.inputs import Basis
from gapbridge.core.calibration.budget.sensitivity import sensitivities
from gapbridge.core.calibration.result import Estimate

UM = 1e-6
HELD = [False] * 20 + [True] * 10


def session(scatter=0.0, seed=0, **given):
    """Return a calibration of 30 readings, ten of them held out, that miss by ``scatter``."""
    error = np.random.default_rng(seed).normal(0, scatter, (30, 3))
    return hand_made(error, held_out=HELD, **given)


def part(found, *bases):
    return next(i for i in found.inputs if i.basis in bases)


def test_inputs_combine_in_squares():
    found = budget(session())
    # 30 um in 3D is 30/sqrt(3) along an axis; scatter of 20 um less the instrument's 10 um
    parameters, arm = 30 / np.sqrt(3), np.sqrt(20**2 - 10**2)
    assert found.combined / UM == pytest.approx(np.hypot(parameters, arm), rel=1e-6)
    assert found.expanded == pytest.approx(2 * found.combined)


def test_effective_freedom_is_of_welch_and_satterthwaite():
    found = budget(session())
    rule = found.combined**4 / sum(i.std**4 / i.freedom for i in found.inputs if i.std)
    assert found.freedom == pytest.approx(rule)
    assert found.coverage == pytest.approx(1 - 2 * student.sf(2, found.freedom))
    assert 2 * student.sf(found.needed_factor, found.freedom) == pytest.approx(0.0455)


def test_few_readings_ask_for_a_larger_factor():
    few = budget(session(freedom=4.0, tcp_std=np.full(10, 2e-4)))
    assert few.freedom < 5
    assert few.needed_factor > 2.5
    assert few.coverage < 0.9


def test_enough_repeats_show_the_arms_scatter_by_themselves():
    alone = budget(session(repeatability=7e-6))
    repeated = budget(session(repeatability=7e-6, pose=[0, 0, 0, 1, 1, 1, 2, 2, 2, *range(3, 24)]))
    assert part(alone, Basis.FIT_SCATTER).std == pytest.approx(np.sqrt(3) * 1e-5)
    assert part(repeated, Basis.REPEATS).std == 7e-6
    assert part(repeated, Basis.REPEATS).freedom == 3 * 6


def test_what_held_out_poses_show_beyond_the_rest_is_an_input():
    inlier = budget(session(scatter=2e-5))
    off = budget(session(scatter=2e-4))
    assert part(inlier, Basis.HELD_OUT).std < 1e-5
    left = part(off, Basis.HELD_OUT).std
    assert left == pytest.approx(2e-4, rel=0.25)
    assert off.inside / off.looked_at > 0.85
    assert not off.doubtful


def test_one_blunder_is_named_and_no_uncertainty():
    good = session(scatter=2e-5)
    held = good.held_out_after.vector.copy()
    held[4] += 3e-3
    error = np.vstack([good.after.vector, held])
    found = budget(hand_made(error, held_out=HELD))
    assert found.combined < 1e-4
    assert part(found, Basis.HELD_OUT).values == (27, (24,))
    assert found.looked_at == 27


def test_errors_far_beyond_an_honest_budget_are_doubtful():
    found = budget(session(scatter=2e-5))
    small = replace(found, inside=15)
    assert not found.doubtful
    assert small.doubtful


ESTIMATES = (Estimate("joint_offset_2", 0.0, 1e-5, "rad"),
             Estimate("joint_offset_3", 0.0, 2e-5, "rad"))  # fmt: skip


def test_a_joints_sensitivity_is_its_lever():
    covariance = np.diag([1e-10, 4e-10])
    c = session(estimates=ESTIMATES, covariance=covariance)
    found = sensitivities(c)
    assert found is not None
    jacobian = c.model.linear_form(c.readings.q[c.readings.held_out]).jacobian[:, :3]
    for k, joint in enumerate((1, 2)):
        lever = np.sqrt(np.mean(jacobian[:, :, joint] ** 2))
        assert found.each[k].coefficient == pytest.approx(lever, rel=1e-5)
    assert found.correlation == pytest.approx(0.0, abs=1e-16)
    total = np.sqrt(sum(s.contribution**2 for s in found.each))
    assert found.combined == pytest.approx(total, rel=1e-6)


def test_correlations_take_away_what_parameters_do_together():
    covariance = np.array([[1e-10, -1.9e-10], [-1.9e-10, 4e-10]])
    found = sensitivities(session(estimates=ESTIMATES, covariance=covariance))
    assert found is not None
    assert found.correlation < 0
    assert found.combined < max(s.contribution for s in found.each)


def test_names_of_no_effect_have_no_sensitivities():
    strange = (Estimate("something_else", 0.0, 1e-5, "m"),)
    c = session(estimates=strange, covariance=np.eye(1))
    assert sensitivities(c) is None
    assert budget(c).parameters is None


def test_closures_are_no_check_of_the_tools_place():
    found = budget(session(scatter=2e-5, kind="sphere"))
    assert found.looked_at == 0
    assert not found.doubtful
