"""Expected deviations against the scatter over repeated sessions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planned_cell import LOADS, POSITION, SIGMA, readings_of, small_model, small_space

from benchmarks.calibration.repeated import repeated_sessions
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.loads import Loads
from gapbridge.core.planning.design import SessionDesign, plan
from gapbridge.core.planning.information import Reference, expected_accuracy, whitened_rows


def expectation(parameters, observable, readings, nuisance, sigma, reference):
    """Return what the fitted readings determine, put together from what a plan is made of."""
    fitted = readings[np.flatnonzero(~readings.held_out)]
    begin = parameters.model(parameters.begin)
    fitted = replace(fitted, value=observable.predict(begin, fitted, nuisance))
    rows = whitened_rows(parameters, observable, fitted, nuisance, sigma)
    return expected_accuracy(parameters, rows, Reference.of(parameters, *reference))


@pytest.fixture(scope="module")
def parameters() -> Parameters:
    return identifiable_parameters(small_model(), observable=POSITION)


@pytest.fixture(scope="module")
def planned(parameters: Parameters):
    space = small_space(parameters.nominal)
    asked = SessionDesign(poses=24, held_out=3, sigma=SIGMA, stops=200)
    return plan(parameters, POSITION, LOADS, space, asked)


@pytest.mark.slow
def test_scatter_over_sessions_is_what_was_expected(parameters, planned) -> None:
    scatter = repeated_sessions(
        parameters, POSITION, readings_of(planned), Nuisance.zero(), sigma=SIGMA, sessions=600,
        seed=1,
    )  # fmt: skip
    shown = planned.expected.std < parameters.prior / 3  # beyond, the weak prior holds too
    ratio = scatter.std[shown] / planned.expected.std[shown]
    assert shown.sum() > 25
    assert np.mean(ratio) == pytest.approx(1, abs=0.02)
    assert np.abs(ratio - 1).max() < 0.13  # 600 sessions determine a deviation to 3 %, 25 of them


@pytest.mark.slow
def test_expectation_of_a_plans_readings_is_the_plans(parameters, planned) -> None:
    q = np.random.default_rng(0).uniform(-2, 2, (50, 6))
    reference = (q, Loads(payload_mass=np.full(50, 4.0)))
    readings = replace(readings_of(planned), value=np.zeros((len(planned.poses), 3)))
    found = expectation(parameters, POSITION, readings, Nuisance.zero(), SIGMA, reference)
    assert found.std == pytest.approx(planned.expected.std, rel=1e-3)
    assert found.tcp_std_worst > found.tcp_std > 0


def test_twice_the_noise_is_twice_the_deviation(parameters, planned) -> None:
    readings = replace(readings_of(planned), value=np.zeros((len(planned.poses), 3)))
    reference = (np.zeros((1, 6)), Loads())
    one, two = (
        expectation(parameters, POSITION, readings, Nuisance.zero(), sigma, reference)
        for sigma in (1e-6, 2e-6)
    )
    assert two.std == pytest.approx(2 * one.std, rel=2e-2)


def test_what_the_poses_do_not_show_is_infinite(planned) -> None:
    # temperatures stand still in a plan: nothing is learnt of the links' growth
    warm = identifiable_parameters(
        small_model(), ("tool_frame", "thermal_drift"), observable=POSITION
    )
    readings = replace(readings_of(planned), value=np.zeros((len(planned.poses), 3)))
    found = expectation(
        warm, POSITION, readings, Nuisance.zero(), SIGMA, (np.zeros((1, 6)), Loads())
    )
    assert np.isinf(found.std[found.names.index("thermal_drift")])
    assert np.isfinite(found.std[:3]).all()
