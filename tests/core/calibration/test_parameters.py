"""Parameters: which are to be found, which are redundant, and the model that they make."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.blind.arms import ARMS
from benchmarks.calibration.drawings import model_of, real_arm
from gapbridge.core.arm import builtin_arm
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.parameters import DEFAULT, Parameters
from gapbridge.core.effects import Site, Term
from gapbridge.core.errors import InputError
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.notes import Reason

POSITION = make_observable("position")


@pytest.fixture(scope="module")
def model() -> Model:
    tool = np.eye(4)
    tool[:3, 3] = [0.03, 0.02, 0.18]
    return Model(builtin_arm("ur10e"), tool)


@pytest.fixture(scope="module")
def parameters(model: Model) -> Parameters:
    return identifiable_parameters(model, observable=POSITION)


def test_redundant_ones_are_left_out_and_named(parameters: Parameters) -> None:
    reported = {note.values[0]: note for note in parameters.redundant}
    assert reported["joint_offset_1"].reason is Reason.REDUNDANT_WITH_PLACE
    assert any("tool_frame" in name for name in reported["joint_offset_6"].values[1])
    assert "link_geometry_2_d" in reported["link_geometry_3_d"].values[1]
    assert (
        reported["axial_compliance_1"].reason is Reason.NEVER_SHOWN
    )  # weights do not turn a vertical joint
    assert not set(reported) & set(parameters.names)


def test_what_is_left_is_separated_by_readings(parameters: Parameters) -> None:
    # a UR has 4 geometric parameters a joint less the redundant ones (three parallel axes), a
    # tool point, and no more than 6 of the frame; every compliance that weight excites
    geometric = [name for name in parameters.names if "compliance" not in name]
    assert len(geometric) == 21
    assert parameters.joints("radial_compliance") == (1, 2, 3, 4, 5, 6)
    assert set(parameters.joints("axial_compliance")) >= {2, 3, 4, 5}


def test_rank_of_the_kept_is_full_and_of_all_is_not_more(model: Model) -> None:
    from gapbridge.core.calibration.identifiability import _random_readings

    observable = make_observable("pose")
    every = Parameters.of_effects(model)
    kept = identifiable_parameters(model, observable=observable)
    readings, nuisance = _random_readings(model, observable, False, 5)
    ranks = []
    for parameters in (every, kept):
        J, F = observable.columns(parameters, parameters.begin, readings, nuisance)
        whole = np.hstack([J * parameters.scales, F])
        s = np.linalg.svd(whole / np.maximum(np.linalg.norm(whole, axis=0), 1e-9))[1]
        ranks.append(int((s > 1e-5 * s[0]).sum()) - 6)
    assert ranks[1] == len(kept)
    assert len(every) > len(kept)


def test_a_registered_instrument_shows_the_first_joints_zero(model: Model) -> None:
    registered = identifiable_parameters(
        model, observable=make_observable("position", registered=True)
    )
    assert "joint_offset_1" in registered.names


def test_sideways_pulls_show_what_weights_do_not(model: Model) -> None:
    pulled = identifiable_parameters(model, observable=POSITION, pulls=True)
    assert 1 in pulled.joints("axial_compliance")


def test_no_values_are_the_nominal_model(model: Model, parameters: Parameters) -> None:
    assert parameters.model(np.zeros(len(parameters))) == model


def test_values_stand_beyond_what_the_model_already_has(model: Model) -> None:
    soft = model.with_terms([Term("axial_compliance", Site(2), (1e-5,))])
    parameters = identifiable_parameters(soft, ("axial_compliance",), observable=POSITION)
    i = parameters.names.index("axial_compliance_2")
    values = np.zeros(len(parameters))
    values[i] = 2e-5
    changed = parameters.model(values)
    assert [t for t in changed.terms if t.site.joint == 2] == [
        Term("axial_compliance", Site(2), (pytest.approx(3e-5),))
    ]
    assert parameters.lower[i] == pytest.approx(-1e-5)  # the whole flexibility is 0 or more
    q, loads = np.full((1, 6), 0.4), Loads(payload_mass=np.array([8.0]))
    lower = changed.predict(q, loads).position[0, 2]
    assert lower < soft.predict(q, loads).position[0, 2]


def test_effects_are_chosen_by_name_and_joint(model: Model) -> None:
    chosen = (*DEFAULT, "backlash_2", "transmission_error_3", "stiffness_nonlinearity_2")
    parameters = identifiable_parameters(model, chosen, observable=POSITION)
    assert parameters.joints("backlash") == (2,)
    assert "transmission_error_3_order1_sine" in parameters.names
    assert "axial_compliance_2" not in parameters.names  # the stiffening joint holds it
    assert parameters.begin[parameters.names.index("stiffness_nonlinearity_2_softening")] > 0


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        ("backlsh", "did you mean 'backlash'"),
        ("ft_bias", "expected one that measured positions show"),
        ("backlash_9", "a joint of this arm of 6 joints"),
    ],
)
def test_unusable_effects_are_declined_in_one_line(model: Model, effect, expected) -> None:
    with pytest.raises(InputError, match=expected) as caught:
        identifiable_parameters(model, (effect,), observable=POSITION)
    assert "\n" not in str(caught.value)


def test_a_base_that_gives_way_is_found_about_both_axes_wherever_it_is_named(model: Model) -> None:
    # the tilt of joint 1 is their sum; beside it one of them would have to fall below zero
    chosen = [(*DEFAULT, "base_compliance"), ("base_compliance", *DEFAULT)]
    found = [identifiable_parameters(model, effects, observable=POSITION) for effects in chosen]
    assert set(found[0].names) == set(found[1].names)
    assert {"base_compliance_x", "base_compliance_y"} <= set(found[0].names)
    reported = {note.values[0]: note for note in found[0].redundant}
    parts = ("base_compliance_x", "base_compliance_y")
    assert reported["radial_compliance_1"].values[1] == parts


def test_a_payload_is_a_parameter_of_an_arm_whose_softness_is_to_be_found(model: Model) -> None:
    assert (
        "payload"
        in identifiable_parameters(model, (*DEFAULT, "payload"), observable=POSITION).names
    )
    rigid = identifiable_parameters(model, ("joint_offset", "payload"), observable=POSITION)
    assert "payload" not in rigid.names


def test_a_heavy_arm_without_a_rating_is_judged_under_loads_that_it_carries() -> None:
    # under a few kilograms the tilt of its last joint would pass for those before it
    kind = ARMS["heavy210"]
    heavy = model_of(real_arm(kind, tool_position=np.array([0.0, 0.0, 0.6 * kind.tool])))
    registered = make_observable("position", registered=True)
    found = identifiable_parameters(heavy, observable=registered, pulls=True)
    assert found.joints("radial_compliance") == (1, 2, 3, 4, 5, 6)


def test_where_a_wrist_stiffens_is_looked_for_at_the_wrists_own_moment() -> None:
    # at the moment of the whole arm its softening would pass for nothing, and be left out
    heavy = model_of(real_arm(ARMS["heavy210"]))
    effects = (*DEFAULT, "stiffness_nonlinearity_5")
    found = identifiable_parameters(heavy, effects, observable=POSITION, pulls=True)
    assert "stiffness_nonlinearity_5_softening" in found.names
