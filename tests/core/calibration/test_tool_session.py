"""Sessions without an instrument: a tool's tip from joint angles alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.blind.arms import ARMS
from benchmarks.calibration.drawings import model_of, real_arm
from gapbridge.core.calibration.tool_session import calibrate_tool
from gapbridge.core.errors import ExcitationError, InputError
from gapbridge.core.model import Model
from gapbridge.core.planning.tool_plan import plan_tool

Array = NDArray[np.float64]
KIND = ARMS["cobot10"]
BEGIN = np.array([0.3, -1.3, 1.9, -2.2, -1.57, 0.2])
TRUE_TIP = np.array([0.004, -0.003, KIND.tool + 0.006])


def _touched(model: Model, q: Array, noise: float, rng: np.random.Generator) -> Array:
    """Return angles at which the true tip stands where the nominal one would, moved by hand."""
    real = replace(model, tool_in_flange=model.tool_in_flange.copy())
    real.tool_in_flange[:3, 3] = TRUE_TIP
    point = real.predict(q[:1]).position[0]
    out = q.copy()
    for _ in range(30):
        form = real.linear_form(out).jacobian[:, :3]
        gap = point - real.predict(out).position
        out = out + np.einsum("nij,nj->ni", np.linalg.pinv(form), gap)
    form = real.linear_form(out).jacobian[:, :3]
    hand = noise * rng.normal(size=(len(q), 3))
    return np.asarray(out + np.einsum("nij,nj->ni", np.linalg.pinv(form), hand))


@pytest.fixture(scope="module")
def model() -> Model:
    return model_of(real_arm(KIND))


@pytest.mark.slow
def test_intervals_hold_the_tip_in_95_of_100_sessions(model: Model) -> None:
    q = np.array(plan_tool(model, BEGIN, poses=7).poses)
    held, rng = [], np.random.default_rng(0)
    for _ in range(80):
        found = calibrate_tool(model, _touched(model, q, 2e-4, rng))
        held += [
            e.interval[0] <= t <= e.interval[1]
            for e, t in zip(found.estimates, TRUE_TIP, strict=True)
        ]
    assert 0.91 < np.mean(held) < 0.985


def test_the_tip_is_found_and_the_model_then_closes(model: Model) -> None:
    q = np.array(plan_tool(model, BEGIN, poses=8).poses)
    touched = _touched(model, q, 1e-5, np.random.default_rng(1))
    found = calibrate_tool(model, touched)
    assert found.tcp == pytest.approx(TRUE_TIP, abs=5e-5)
    assert found.nominal_residual.max() > 1e-3 > 1e-4 > found.residual.max()
    spread = np.ptp(found.applied(model).predict(touched).position, axis=0)
    assert spread.max() < 1e-4


def test_a_slipped_touch_is_listed(model: Model) -> None:
    q = np.array(plan_tool(model, BEGIN, poses=8).poses)
    touched = _touched(model, q, 5e-5, np.random.default_rng(2))
    touched[3, 1] += 0.02
    found = calibrate_tool(model, touched)
    assert list(found.outliers) == [3]
    assert found.tcp == pytest.approx(TRUE_TIP, abs=3e-4)


def test_a_point_that_was_moved_is_refused_not_taken_for_an_uncertain_tip(model: Model) -> None:
    q = np.array(plan_tool(model, BEGIN, poses=6).poses)
    touched = _touched(model, q, 2e-4, np.random.default_rng(3))
    touched[3:, 0] += 0.08
    with pytest.raises(InputError, match=r"touches \d+\.\d mm .* was the point moved"):
        calibrate_tool(model, touched)


def test_one_axis_is_too_little(model: Model) -> None:
    q = np.tile(BEGIN, (6, 1))
    q[:, 5] += np.linspace(-1, 1, 6)
    with pytest.raises(ExcitationError, match="two axes"):
        calibrate_tool(model, q)


def test_angles_of_another_arm_are_refused(model: Model) -> None:
    with pytest.raises(InputError, match="expected finite ones"):
        calibrate_tool(model, np.zeros((6, 7)))


def test_planned_touches_stay_on_the_point_and_are_as_accurate_as_predicted(model: Model) -> None:
    plan = plan_tool(model, BEGIN, poses=8, noise=2e-4)
    q = np.array(plan.poses)
    assert np.ptp(model.predict(q).position, axis=0).max() < 1e-5
    rng = np.random.default_rng(4)
    found = [calibrate_tool(model, _touched(model, q, 2e-4, rng)).tcp for _ in range(60)]
    assert np.linalg.norm(np.std(found, axis=0)) == pytest.approx(plan.bought[-1][1], rel=0.25)
    sizes = [size for _, size in plan.bought]
    assert sizes == sorted(sizes, reverse=True)
