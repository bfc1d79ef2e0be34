"""Verification months later: does the accuracy baseline hold, and if not, what moved."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.blind.arms import ARMS
from benchmarks.blind.measuring import Instrument
from benchmarks.blind.mechanics import RealArm
from benchmarks.calibration import laid_out
from benchmarks.calibration.drawings import model_of, real_arm
from gapbridge.bridge.calibration.format import verdict_text
from gapbridge.core.calibration.accuracy_baseline import baseline_document, read_baseline
from gapbridge.core.calibration.fit import evaluate_fit, fit_session
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.result import Calibration
from gapbridge.core.calibration.spread import effects_of, parameters_named
from gapbridge.core.calibration.verify import verify
from gapbridge.core.errors import ExcitationError, InputError
from gapbridge.core.metrology import Metrology

KIND = ARMS["cobot10"]
LAYOUT = laid_out.Layout(poses=18, held_out=12, repeated=3)
METROLOGY = Metrology(registered=False, sigma=LAYOUT.sigma)
Calibrated = tuple[Calibration, dict[str, Any], RealArm, Instrument]


@pytest.fixture(scope="module")
def calibrated() -> Calibrated:
    rng = np.random.default_rng(1)
    model = model_of(real_arm(KIND))
    parameters = identifiable_parameters(model, observable=make_observable("position"))
    real = laid_out.arm_with(KIND, laid_out.draw_values(KIND, parameters.names, rng))
    instrument = laid_out.instrument_for(KIND, LAYOUT, rng)
    readings = laid_out.readings_of(real, laid_out.lay_out(KIND, LAYOUT, rng), instrument, rng)
    found = evaluate_fit(model, fit_session(readings, parameters, METROLOGY), diagnose=False)
    document = json.loads(json.dumps(baseline_document(found, METROLOGY.sigma)))
    return found, document, real, instrument


def _again(real: RealArm, instrument: Instrument, seed: int = 0, poses: int = 4) -> Readings:
    """Return readings of a later day: new poses, the instrument elsewhere."""
    rng = np.random.default_rng([seed, 9])
    laid = laid_out.lay_out(KIND, laid_out.Layout(poses=poses, repeated=0, held_out=0), rng)
    elsewhere = replace(instrument, position=rng.uniform(-2, 2, 3))
    return laid_out.readings_of(real, laid, elsewhere, rng)


def test_an_arm_that_did_not_change_holds(calibrated: Calibrated) -> None:
    found, document, real, instrument = calibrated
    chances = [
        verify(found.model, _again(real, instrument, seed), document, METROLOGY).chance
        for seed in range(12)
    ]
    assert min(chances) > 1e-3
    assert 0.15 < np.mean(chances) < 0.85  # neither too proud nor too shy


def test_a_joint_whose_zero_moved_is_named_with_how_far(calibrated: Calibrated) -> None:
    found, document, real, instrument = calibrated
    bumped = laid_out.with_values(real, {"joint_offset_3": 4e-4})
    seen = verify(found.model, _again(bumped, instrument), document, METROLOGY)
    assert not seen.holds
    assert seen.moved is not None
    assert seen.moved.name == "joint_offset_3"
    low, high = seen.moved.estimates[0].interval
    assert low < 4e-4 < high
    assert "joint 3" in verdict_text(seen)


@pytest.mark.parametrize("size", [0.01, 0.05])
def test_a_zero_that_moved_far_is_named_all_the_same(calibrated: Calibrated, size: float) -> None:
    found, document, real, instrument = calibrated
    slipped = laid_out.with_values(real, {"joint_offset_5": size})
    seen = verify(found.model, _again(slipped, instrument, poses=8), document, METROLOGY)
    assert seen.moved is not None
    assert seen.moved.name == "joint_offset_5"
    assert abs(seen.moved.estimates[0].value - size) < 4.0 * seen.moved.estimates[0].std
    assert "the zero of joint 5 moved by" in verdict_text(seen)


def test_a_zero_that_the_calibration_left_open_may_be_off_by_as_much(
    calibrated: Calibrated,
) -> None:
    found, document, real, instrument = calibrated
    baseline = read_baseline(document)
    covariance = baseline.covariance.copy()
    at = baseline.names.index("joint_offset_3")
    covariance[at, at] += 4e-4**2
    readings = _again(laid_out.with_values(real, {"joint_offset_3": 4e-4}), instrument)
    stated = verify(found.model, readings, baseline, METROLOGY)
    vague = verify(found.model, readings, replace(baseline, covariance=covariance), METROLOGY)
    assert vague.holds and not stated.holds
    assert np.all(vague.predicted > stated.predicted)


def test_a_tool_that_was_deflected_is_named(calibrated: Calibrated) -> None:
    found, document, real, instrument = calibrated
    deflected = laid_out.with_values(real, {"tool_frame_x": 4e-4, "tool_frame_z": -2e-4})
    seen = verify(found.model, _again(deflected, instrument), document, METROLOGY)
    assert seen.moved is not None
    assert seen.moved.name == "tool_frame"


def test_one_bad_reading_is_not_blamed_on_the_arm(calibrated: Calibrated) -> None:
    found, document, real, instrument = calibrated
    readings = _again(real, instrument)
    value = readings.value.copy()
    value[4] += [1e-3, 0, 0]
    seen = verify(found.model, replace(readings, value=value), document, METROLOGY)
    assert not seen.holds
    assert seen.moved is not None
    assert seen.moved.name == "reading_5"


def test_what_no_single_change_explains_asks_for_a_new_calibration(calibrated: Calibrated) -> None:
    found, document, real, instrument = calibrated
    rng = np.random.default_rng(3)
    other = laid_out.with_values(
        real, {f"joint_offset_{j}": 1e-3 * rng.normal() for j in range(2, 6)}
    )
    seen = verify(found.model, _again(other, instrument, poses=6), document, METROLOGY)
    assert not seen.holds
    assert seen.moved is None
    assert "recalibrate" in verdict_text(seen)


def test_a_registered_instrument_that_was_knocked_is_named(calibrated: Calibrated) -> None:
    found, document, real, instrument = calibrated
    laid = laid_out.lay_out(
        KIND, laid_out.Layout(poses=4, repeated=0, held_out=0), np.random.default_rng(4)
    )
    place = found.stations[0]
    here = replace(instrument, rotation=place.rotation, position=place.position)
    readings = laid_out.readings_of(real, laid, here, np.random.default_rng(5))
    in_base = replace(readings, value=place.in_base(readings.value))
    in_base = replace(in_base, value=in_base.value + np.array([2e-3, 0, 1e-3]))
    seen = verify(found.model, in_base, document, Metrology(True, LAYOUT.sigma))
    assert seen.moved is not None
    assert seen.moved.name == "instrument"


def test_too_few_readings_say_so(calibrated: Calibrated) -> None:
    found, document, real, instrument = calibrated
    with pytest.raises(ExcitationError, match="expected more poses"):
        verify(found.model, _again(real, instrument)[np.arange(2)], document, METROLOGY)


def test_a_document_that_is_none_is_named(calibrated: Calibrated) -> None:
    document = calibrated[1]
    with pytest.raises(InputError, match="schema"):
        read_baseline({"schema": "other"}, "calibration.json")
    with pytest.raises(InputError, match="'noise'"):
        read_baseline({k: v for k, v in document.items() if k != "noise"}, "calibration.json")


@pytest.mark.parametrize(
    "damage",
    [
        {"freedom": 0.0},
        {"covariance": np.nan},
        {"covariance": -1.0},
        {"noise": {"sigma": None, "instrument": 0.0, "turn": None, "joint": 0.0}},
    ],
)
def test_a_baseline_with_impossible_numbers_is_named(
    calibrated: Calibrated, damage: dict[str, Any]
) -> None:
    document = dict(calibrated[1])
    if "covariance" in damage:
        damage = {"covariance": (damage["covariance"] * np.array(document["covariance"])).tolist()}
    with pytest.raises(InputError, match=r"^calibration.json: found something unusable"):
        read_baseline({**document, **damage}, "calibration.json")


def test_a_curve_at_one_joint_leaves_another_its_flexibility() -> None:
    """Else no command reads a cell with both that `diagnose --apply` wrote."""
    model = model_of(real_arm(ARMS["cobot5"]))
    curve = ("stiffness_nonlinearity_2_compliance", "stiffness_nonlinearity_2_softening")
    for names in (("axial_compliance_4", *curve), (*curve, "axial_compliance_4")):
        assert parameters_named(model, names, "provenance").names == names
    with pytest.raises(InputError, match="found 'axial_compliance_9', expected a parameter of"):
        parameters_named(model, ("axial_compliance_9",), "provenance")


def test_effects_are_read_off_the_parameters_names() -> None:
    assert effects_of(("joint_offset_2", "link_geometry_1_a", "joint_offset_3")) == (
        "joint_offset_2",
        "link_geometry_1",
        "joint_offset_3",
    )
    with pytest.raises(InputError, match="nonsense"):
        effects_of(("nonsense_1",))
