"""Steps that are tried before they are taken: products of parameters do not make a fit run away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.blind.arms import ARMS
from benchmarks.blind.mechanics import RealArm
from benchmarks.calibration import laid_out
from benchmarks.calibration.drawings import model_of, real_arm
from gapbridge.core.calibration.fit import evaluate_fit, fit_session
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.parameters import DEFAULT, Parameters
from gapbridge.core.calibration.problem import bounds_of
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.estimation.linear_system import Bounds, System, solve
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

KIND = ARMS["cobot5"]
LAYOUT = laid_out.Layout(poses=18, held_out=10, repeated=3)
SEED = 6  # undamped steps converged 15 deviations away from it
POSITION = make_observable("position")


def _drawn() -> RealArm:
    """Return the arm as its cell has it: it is softer than that."""
    return real_arm(KIND, axial=0.7 * np.array(KIND.axial), radial=0.7 * np.array(KIND.radial))


@pytest.fixture(scope="module")
def model() -> Model:
    return model_of(_drawn())


@pytest.fixture(scope="module")
def parameters(model: Model) -> Parameters:
    return identifiable_parameters(model, ("payload", *DEFAULT), observable=POSITION)


def _session(parameters: Parameters, extra: float) -> Readings:
    """Return readings under loads that are heavier than declared by ``extra`` kg."""
    rng = np.random.default_rng(SEED)
    names = [n for n in parameters.names if n != "payload"]
    real = laid_out.with_values(_drawn(), laid_out.draw_values(KIND, names, rng))
    laid, instrument = (
        laid_out.lay_out(KIND, LAYOUT, rng),
        laid_out.instrument_for(KIND, LAYOUT, rng),
    )
    mass = laid.session.payload_mass
    heavy = replace(laid.session, payload_mass=mass + extra)
    readings = laid_out.readings_of(real, replace(laid, session=heavy), instrument, rng)
    return replace(readings, loads=replace(readings.loads, payload_mass=mass))


def test_a_payload_beside_flexibilities_is_found_and_does_not_run_away(
    model: Model, parameters: Parameters
) -> None:
    readings = _session(parameters, 2.5)
    metrology = Metrology(registered=False, sigma=LAYOUT.sigma)
    found = evaluate_fit(model, fit_session(readings, parameters, metrology), diagnose=False)
    payload = next(e for e in found.estimates if e.name == "payload")
    assert payload.interval[0] < 2.5 < payload.interval[1]
    assert found.held_out_after.rms < 1.5 * np.sqrt(3) * found.noise
    assert found.held_out_before.rms > 20 * found.held_out_after.rms


def test_what_one_load_cannot_show_is_reported_and_harms_no_prediction(
    model: Model, parameters: Parameters
) -> None:
    readings = _session(parameters, 1.0)
    one = readings[np.flatnonzero(readings.load == 0)]
    metrology = Metrology(registered=False, sigma=LAYOUT.sigma)
    found = evaluate_fit(model, fit_session(one, parameters, metrology), diagnose=False)
    payload = next(e for e in found.estimates if e.name == "payload")
    assert payload.interval[0] < 1.0 < payload.interval[1]
    assert not payload.shown or payload.std > 0.2
    assert any(note.values[0] == "payload" for note in found.combinations) or payload.shown
    assert found.held_out_after.rms < 0.3 * found.held_out_before.rms


def test_what_hangs_on_an_arm_weighs_nothing_or_more(parameters: Parameters) -> None:
    readings = _session(parameters, 0.0)
    lightest = float(readings.loads.payload_mass.min())  # type: ignore[union-attr]
    bounds = bounds_of(parameters, readings)
    assert bounds.lower[parameters.names.index("payload")] == pytest.approx(-lightest)


def test_damping_shortens_what_two_parameters_hardly_separated_most() -> None:
    rng = np.random.default_rng(0)
    first, other = rng.normal(size=(2, 40))
    J = np.column_stack([first, first + 1e-3 * other])  # their difference is hardly determined
    system = System(J, np.zeros((40, 0)), J @ [3.0, -2.0])
    wide = Bounds(np.full(2, -np.inf), np.full(2, np.inf), np.full(2, 1e6), np.zeros(2))
    free = np.ones(2, dtype=bool)
    full, damped = (solve(system, np.zeros(2), wide, free, d)[0] for d in (0.0, 1e-3))
    assert full == pytest.approx([3.0, -2.0], abs=1e-4)
    assert damped.sum() == pytest.approx(1.0, rel=0.01)
    assert abs(damped[0] - damped[1]) < 0.1
