"""The fit of a session, against truths by the blind benchmark's mechanics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.blind.arms import ARMS
from benchmarks.blind.ingredients import backlash
from benchmarks.blind.measuring import Instrument
from benchmarks.calibration import laid_out
from benchmarks.calibration.drawings import model_of, real_arm
from gapbridge.core.calibration.fit import evaluate_fit, fit_session
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.parameters import DEFAULT, Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.result import Calibration
from gapbridge.core.errors import ExcitationError
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason

KIND = ARMS["cobot10"]
LAYOUT = laid_out.Layout(poses=18, held_out=12, repeated=6)
METROLOGY = Metrology(registered=False, sigma=LAYOUT.sigma)


@pytest.fixture(scope="module")
def model() -> Model:
    return model_of(real_arm(KIND))


@pytest.fixture(scope="module")
def parameters(model: Model) -> Parameters:
    return identifiable_parameters(model, observable=make_observable("position"))


def reasons(found):
    return {note.reason for note in found.notes}


def _session(
    parameters: Parameters, seed: int, *, exact: bool = False
) -> tuple[Readings, dict[str, float], Instrument]:
    rng = np.random.default_rng(seed)
    truth = laid_out.draw_values(KIND, parameters.names, rng)
    laid, instrument = (
        laid_out.lay_out(KIND, LAYOUT, rng),
        laid_out.instrument_for(KIND, LAYOUT, rng),
    )
    real = laid_out.arm_with(KIND, truth)
    return laid_out.readings_of(real, laid, instrument, None if exact else rng), truth, instrument


@pytest.fixture(scope="module")
def session(parameters: Parameters) -> tuple[Readings, dict[str, float], Instrument]:
    return _session(parameters, 1)


@pytest.fixture(scope="module")
def found(
    model: Model, parameters: Parameters, session: tuple[Readings, dict[str, float], Instrument]
) -> Calibration:
    return evaluate_fit(model, fit_session(session[0], parameters, METROLOGY), diagnose=False)


def test_without_noise_the_truth_is_found(model: Model, parameters: Parameters) -> None:
    readings, truth, _ = _session(parameters, 0, exact=True)
    exact = evaluate_fit(model, fit_session(readings, parameters, METROLOGY), diagnose=False)
    off = [abs(e.value - truth[e.name]) for e in exact.estimates]
    assert np.max(np.array(off) / parameters.scales) < 0.02
    assert exact.held_out_after.max < 1e-6 < 1e-3 < exact.held_out_before.rms


def test_held_out_poses_are_as_near_as_instrument_and_arm_allow(
    found: Calibration, session: tuple[Readings, dict[str, float], Instrument]
) -> None:
    expected = np.sqrt(3 * found.noise**2 + np.mean(found.tcp_std**2))
    assert found.held_out_after.rms == pytest.approx(expected, rel=0.35)
    assert found.held_out_before.rms > 20 * found.held_out_after.rms
    assert list(found.held_out_after.rows) == list(np.flatnonzero(session[0].held_out))
    assert found.complete


@pytest.mark.parametrize("verified", ["before the knock", "after it"])
def test_an_instrument_that_moved_leaves_some_poses_to_verify_in_one_place_only(
    model: Model, parameters: Parameters, session: tuple[Readings, dict[str, float], Instrument],
    verified: str,
) -> None:  # fmt: skip
    """Where it stands now is found from poses there, to verify or not; nothing breaks over it."""
    readings = session[0]
    held, second = readings.held_out, np.zeros(len(readings), dtype=np.int64)
    second[np.flatnonzero(held if verified == "after it" else ~held)[-6:]] = 1
    some = evaluate_fit(
        model, fit_session(replace(readings, station=second), parameters, METROLOGY), diagnose=False
    )
    assert len(some.stations) == 2
    np.testing.assert_allclose(some.stations[1].position, some.stations[0].position, atol=2e-3)
    lost = verified == "after it"
    assert len(some.held_out_after.rows) == held.sum() - 6 * lost
    assert (Reason.VERIFYING_FITTED in reasons(some)) == lost
    assert some.held_out_after.rms < 2e-4


def test_noise_of_instrument_and_arm_are_separated(
    found: Calibration, session: tuple[Readings, dict[str, float], Instrument]
) -> None:
    instrument = session[2]
    assert found.instrument_noise == pytest.approx(instrument.sigma, rel=0.4)
    assert found.joint_noise == pytest.approx(instrument.joint_sigma, rel=0.6)
    assert 0 <= found.repeatability < 3 * found.noise


def test_intervals_hold_the_truth_in_95_of_100(model: Model, parameters: Parameters) -> None:
    held = []
    for seed in range(2, 8):
        readings, truth, _ = _session(parameters, seed)
        some = evaluate_fit(model, fit_session(readings, parameters, METROLOGY), diagnose=False)
        held += [e.interval[0] <= truth[e.name] <= e.interval[1] for e in some.estimates if e.shown]
    assert 0.89 < np.mean(held) < 0.99  # six sessions; the benchmark takes 500


def test_held_out_readings_never_touch_the_fit(
    model: Model,
    parameters: Parameters,
    found: Calibration,
    session: tuple[Readings, dict[str, float], Instrument],
) -> None:
    readings = session[0]
    value = readings.value.copy()
    value[readings.held_out] += 0.05
    spoilt = evaluate_fit(
        model, fit_session(replace(readings, value=value), parameters, METROLOGY), diagnose=False
    )
    assert [e.value for e in spoilt.estimates] == [e.value for e in found.estimates]
    assert not spoilt.complete
    assert Reason.HELD_OUT_FAR in reasons(spoilt)


def test_outlier_readings_are_listed_and_change_little(
    model: Model,
    parameters: Parameters,
    found: Calibration,
    session: tuple[Readings, dict[str, float], Instrument],
) -> None:
    readings = session[0]
    value = readings.value.copy()
    value[[4, 30]] += [[0.0, 3e-4, 0.0], [0.02, 0.0, 0.01]]
    outlier = evaluate_fit(
        model, fit_session(replace(readings, value=value), parameters, METROLOGY), diagnose=False
    )
    assert list(outlier.outliers) == [4, 30]
    off = [
        abs(w.value - f.value) / f.std
        for w, f in zip(outlier.estimates, found.estimates, strict=True)
    ]
    assert max(off) < 2.0
    assert outlier.held_out_after.rms < 1.15 * found.held_out_after.rms


def test_flexibilities_stay_at_zero_or_above(model: Model, parameters: Parameters) -> None:
    rng = np.random.default_rng(5)
    truth = {
        n: v
        for n, v in laid_out.draw_values(KIND, parameters.names, rng).items()
        if "compliance" not in n
    }
    laid, instrument = (
        laid_out.lay_out(KIND, LAYOUT, rng),
        laid_out.instrument_for(KIND, LAYOUT, rng),
    )
    readings = laid_out.readings_of(laid_out.arm_with(KIND, truth), laid, instrument, rng)
    stiff = evaluate_fit(model, fit_session(readings, parameters, METROLOGY), diagnose=False)
    soft = [e for e in stiff.estimates if "compliance" in e.name]
    assert all(e.value >= 0 for e in soft)
    assert any(e.on_bound for e in soft)
    assert all(e.std > 0 for e in soft)  # a parameter on its bound keeps its width
    assert Reason.ON_BOUND in reasons(stiff)


def test_a_load_that_was_wrongly_declared_leaves_differences_at_odds_or_shows_held_out(
    model: Model, parameters: Parameters
) -> None:
    rng = np.random.default_rng(6)
    truth = laid_out.draw_values(KIND, parameters.names, rng)
    laid, instrument = (
        laid_out.lay_out(KIND, LAYOUT, rng),
        laid_out.instrument_for(KIND, LAYOUT, rng),
    )
    real = laid_out.arm_with(KIND, truth)
    heavy = laid.load == 2
    session = replace(laid.session, payload_mass=laid.session.payload_mass * np.where(heavy, 0, 1))
    readings = laid_out.readings_of(real, replace(laid, session=session), instrument, rng)
    declared = replace(readings.loads, payload_mass=laid.session.payload_mass)
    wrong = evaluate_fit(
        model, fit_session(replace(readings, loads=declared), parameters, METROLOGY), diagnose=False
    )
    assert not wrong.complete or Reason.LOADS_AT_ODDS in reasons(wrong)


def test_what_is_left_to_be_added_is_named_and_then_completes_it(
    model: Model, parameters: Parameters
) -> None:
    rng = np.random.default_rng(7)
    truth = laid_out.draw_values(KIND, parameters.names, rng)
    laid, instrument = (
        laid_out.lay_out(KIND, LAYOUT, rng),
        laid_out.instrument_for(KIND, LAYOUT, rng),
    )
    approach = rng.choice([-1.0, 1.0], laid.session.q.shape)
    came = replace(laid.session, approach=approach, from_where=laid.session.q - 0.05 * approach)
    real = backlash(3, 8e-4).apply(laid_out.arm_with(KIND, truth))
    readings = laid_out.readings_of(real, replace(laid, session=came), instrument, rng)
    readings = replace(readings, loads=replace(readings.loads, approach=approach))
    found = evaluate_fit(model, fit_session(readings, parameters, METROLOGY), diagnose=False)
    assert not found.complete
    assert found.missing_effects == ("backlash_3",)
    names = (*DEFAULT, *found.missing_effects)
    more = identifiable_parameters(model, names, observable=make_observable("position"))
    whole = evaluate_fit(model, fit_session(readings, more, METROLOGY), diagnose=False)
    assert whole.complete
    assert whole.missing_effects == ()
    play = next(e for e in whole.estimates if e.name == "backlash_3")
    assert play.interval[0] < 8e-4 < play.interval[1]


@pytest.mark.parametrize(("alone", "fitted"), [(2, True), (3, False)])
def test_a_place_that_too_few_fitted_poses_determine_takes_those_to_verify_as_well(
    model: Model, parameters: Parameters, session: tuple[Readings, dict[str, float], Instrument],
    alone: int, fitted: bool,
) -> None:  # fmt: skip
    """Two positions leave a frame free to turn about their line; a repeat is no third."""
    readings = session[0]
    poses = np.unique(readings.pose[~readings.held_out])[:alone]
    second = np.isin(readings.pose, poses).astype(np.int64)
    second[np.flatnonzero(readings.held_out)[-4:]] = 1
    some = evaluate_fit(
        model, fit_session(replace(readings, station=second), parameters, METROLOGY), diagnose=False
    )
    assert (Note(Reason.VERIFYING_FITTED, (4,)) in some.notes) == fitted
    assert len(some.held_out_after.rows) == readings.held_out.sum() - 4 * fitted
    assert some.held_out_after.rms < 2e-3


def test_the_diagnosis_finds_nothing_in_what_a_complete_calibration_leaves(
    model: Model, parameters: Parameters, session: tuple[Readings, dict[str, float], Instrument]
) -> None:
    whole = evaluate_fit(model, fit_session(session[0], parameters, METROLOGY))
    assert whole.complete
    assert whole.diagnosis is not None
    assert whole.diagnosis.verdict == "no_gap"


def test_two_places_of_the_instrument_each_have_their_frame(
    model: Model, parameters: Parameters, session: tuple[Readings, dict[str, float], Instrument]
) -> None:
    readings = session[0]
    second = np.arange(len(readings)) % 2 == 1
    value = readings.value.copy()
    value[second] = value[second] @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]) + [1, 2, 3]
    moved = replace(readings, value=value, station=second.astype(np.int64))
    both = evaluate_fit(model, fit_session(moved, parameters, METROLOGY), diagnose=False)
    assert len(both.stations) == 2
    assert both.held_out_after.rms < 1e-4


def test_too_few_readings_are_refused(
    model: Model, parameters: Parameters, session: tuple[Readings, dict[str, float], Instrument]
) -> None:
    with pytest.raises(ExcitationError, match="measure more poses"):
        evaluate_fit(model, fit_session(session[0][np.arange(8)], parameters, METROLOGY))


def test_only_held_out_readings_are_refused(
    model: Model, parameters: Parameters, session: tuple[Readings, dict[str, float], Instrument]
) -> None:
    away = session[0][session[0].held_out]
    with pytest.raises(ExcitationError, match="all are held out"):
        evaluate_fit(model, fit_session(away, parameters, METROLOGY))
