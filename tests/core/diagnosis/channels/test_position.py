"""The position channel, whole, on a small arm whose truth is made by other code."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small

from gapbridge.bridge.document.diagnosis_json import document
from gapbridge.core.diagnosis import channel_search
from gapbridge.core.diagnosis.channels.position import observe
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.finding import ChannelFinding, Check, NotAccused
from gapbridge.core.effects import Site, Term
from gapbridge.core.errors import LogError
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

# what the arm has more than the model, by its names in cells
TRUE = {
    "joint_offset": {"joint_offset_2": 8e-4},
    "transmission_error": {
        "transmission_error_3_order2_amplitude": 6e-4, "transmission_error_3_order2_phase": 0.7,
    },
    "backlash": {"backlash_2": 9e-4},
    "axial_compliance": {"axial_compliance_2": 4e-6},
    "payload": {"payload": 1.5},
    "tool_frame": {"tool_frame_x": 4e-4, "tool_frame_y": -3e-4, "tool_frame_z": 5e-4},
    "gravity_direction": {"gravity_direction_x": 0.05, "gravity_direction_y": -0.06},
    "thermal_drift": {"thermal_drift": 2.4e-5},
}  # fmt: skip
JOINTS = {"joint_offset": (2,), "transmission_error": (3,), "backlash": (2,),
          "axial_compliance": (2,)}  # fmt: skip
FREE_FRAME = ("tool_frame", "backlash", "payload")


@pytest.mark.parametrize(
    ("effect", "registered"),
    [(e, True) for e in TRUE] + [(e, False) for e in FREE_FRAME],
)
def test_a_cause_is_named_with_its_joint_and_its_size(effect, registered):
    found = small.diagnosed(effect, 0, registered)
    (channel,) = found.channels
    assert (found.verdict, channel.verdict) == ("explained", "explained")
    (cause,) = channel.causes
    assert (cause.effect, cause.joints) == (effect, JOINTS.get(effect, ()))
    reported = {p.name: p for p in cause.parameters}
    for name, value in TRUE[effect].items():
        assert abs(reported[name].value - value) < 4 * reported[name].std
    assert cause.shrink.shrink > 0.3 or effect == "gravity_direction"
    assert cause.shrink.interval[0] < cause.shrink.shrink < cause.shrink.interval[1]
    assert channel.remaining_rms_held_out < 1.2 * small.FLOOR
    assert channel.remaining_rms <= channel.remaining_rms_held_out < channel.gap_rms


def test_what_makes_the_gap_larger_is_no_cause(monkeypatch):
    """A force sensor with x and y swapped: its turn of 2.6 rad was compared to first order."""

    def larger(*arguments):
        sizes = sizes_of(*arguments)
        return replace(sizes, remaining_rms=1.1 * sizes.gap_rms)

    sizes_of = channel_search.sizes_of
    monkeypatch.setattr(channel_search, "sizes_of", larger)
    session = small.session_of(0)
    read = small.readings(small.turned(2, lambda s, q: np.full(len(q), 8e-4)), session)
    found = diagnose(
        small.model_of(), small.log_of(session, read), Metrology(registered=True, sigma=small.SIGMA)
    )
    (channel,) = found.channels
    assert (channel.verdict, channel.causes, found.model.terms) == ("unexplained", (), ())
    assert channel.remaining_rms == channel.remaining_rms_held_out == channel.gap_rms
    facts = [f.fact for f in found.findings if isinstance(f, ChannelFinding)]
    assert [f.reason.failed for f in facts if isinstance(f, NotAccused)] == [Check.ALL_ROWS_GAIN]


def test_a_remounted_tools_columns_are_those_of_the_arm_found():
    """At the nominal arm they are off by as much as its zeros: a turn of the last joint stood."""
    session, model = small.session_of(0), small.model_of()
    log = small.log_of(session, small.readings(small.NOMINAL, session))
    observation = observe(model, log, Metrology(sigma=small.SIGMA, remounted=True))
    terms = (Term("joint_offset", Site(2), (0.05,)), Term("joint_offset", Site(3), (0.04,)))
    there = observation.rebase(np.zeros(observation.nuisance.shape[2]), terms)
    tool, h = there.nuisance[:, :, 6:9], 1e-6
    for k in range(3):
        step = np.zeros(observation.nuisance.shape[2])
        step[6 + k] = h
        moved = observation.rebase(step, terms)
        slope = (moved.predict(terms) - there.predict(terms)) / h
        assert np.abs(tool[:, :, k] - slope).max() < 1e-6
    assert np.abs(tool - observation.nuisance[:, :, 6:9]).max() > 0.01


@pytest.mark.parametrize("registered", [True, False])
def test_a_clean_log_has_no_cause(registered):
    found = small.diagnosed("none", 0, registered)
    (channel,) = found.channels
    assert (found.verdict, channel.causes, channel.structured) == ("no_gap", (), False)
    assert channel.unexplained_rms == 0
    assert channel.gap_rms == pytest.approx(small.FLOOR, rel=0.15)
    assert channel.noise_floor_rms == pytest.approx(small.FLOOR, rel=0.15)
    assert channel.p_value > 0.002
    assert found.terms == ()


def test_an_effect_outside_the_catalogue_is_reported_as_unexplained():
    found = small.diagnosed("cross_coupling")
    (channel,) = found.channels
    assert (found.verdict, channel.causes) == ("unexplained", ())
    assert channel.structured
    assert channel.unexplained_rms > 3 * small.FLOOR
    assert "actual_q_1" in [name for name, _ in channel.depends_on[:3]]


def test_a_withheld_effect_is_not_replaced_by_another():
    found = small.diagnosed("backlash", withhold=("backlash",))
    (channel,) = found.channels
    assert channel.causes == ()
    assert channel.structured
    assert "approach_1" in [name for name, _ in channel.depends_on[:3]]
    assert "backlash" not in {c.effect for c in channel.considered}


def test_two_causes_are_both_named_the_larger_share_first():
    both = small.replace(
        small.REAL["backlash"],
        angle_errors=small.REAL["backlash"].angle_errors + small.REAL["joint_offset"].angle_errors,
        tool_position=small.REAL["tool_frame"].tool_position,
    )
    session = small.session_of(5)
    log = small.log_of(session, small.readings(both, session, 5))
    metrology = Metrology(registered=True, sigma=small.SIGMA)
    (channel,) = small.diagnose(small.model_of(), log, metrology).channels
    named = {(c.effect, c.joints) for c in channel.causes}
    assert named == {("backlash", (2,)), ("joint_offset", (2,)), ("tool_frame", ())}
    gaps = [c.shrink.gap_without for c in channel.causes]
    assert gaps == sorted(gaps, reverse=True)
    for cause in channel.causes:  # given the others, and alone
        assert cause.shrink.gap_with == pytest.approx(channel.remaining_rms_held_out, rel=1e-9)
        assert cause.shrink_alone < cause.shrink.shrink


def test_the_model_with_causes_predicts_the_real_arm_at_other_poses():
    found = small.diagnosed("thermal_drift")
    assert isinstance(found.model, Model)
    session = small.session_of(77)
    true = small.stand(small.REAL["thermal_drift"], session).tcp
    loads = small.log_of(session, true).loads()
    before = small.model_of().predict(session.q, loads).position - true
    after = found.model.predict(session.q, loads).position - true
    assert np.abs(after).max() < 0.05 * np.abs(before).max()


def test_where_the_gap_lies_is_reported_in_shares():
    (channel,) = small.diagnosed("joint_offset").channels
    shares = dict(channel.where.joints)
    assert max(shares, key=lambda j: shares[j]) == 2
    assert sum(channel.where.axes) == pytest.approx(1)
    assert all(0 <= share <= 1 for share in (*shares.values(), *channel.where.axes))


def test_the_json_holds_the_same_figures_and_nothing_that_is_no_number():
    found = small.diagnosed("payload")
    reported = document(found)
    (channel,) = reported["channels"]
    assert reported["schema"] == "gapbridge.diagnosis/1"
    assert channel["causes"][0]["parameters"][0]["value"] == found.terms[0].values[0]
    assert channel["gap_rms"] == found.channels[0].gap_rms
    considered = {c["effect"]: c for c in channel["considered"]}
    assert "payload" not in considered
    assert {c["probability"] <= 0.5 for c in considered.values()} == {True}

    def walk(value):
        children = value.values() if isinstance(value, dict) else value
        for child in children if isinstance(value, dict | list) else ():
            walk(child)
        assert not (isinstance(value, float) and not np.isfinite(value))

    walk(reported)


def test_rows_without_a_reading_are_left_out():
    session = small.session_of(0)
    read = small.readings(small.REAL["axial_compliance"], session)
    read[[4, 9]] = np.nan
    log = small.log_of(session, read)
    metrology = Metrology(registered=True, sigma=small.SIGMA)
    (channel,) = small.diagnose(small.model_of(), log, metrology).channels
    assert channel.samples == 58
    assert [(c.effect, c.joints) for c in channel.causes] == [("axial_compliance", (2,))]
    whole = small.diagnosed("axial_compliance").channels[0].causes[0].parameters[0]
    assert abs(channel.causes[0].parameters[0].value - whole.value) < 2 * whole.std


def test_too_few_rows_are_refused_with_what_each_channel_needs():
    session = small.session_of(0)
    log = small.log_of(session, small.readings(small.NOMINAL, session)).select(np.arange(3))
    with pytest.raises(
        LogError, match=r"position: at least 4 rows \(found 3\); wrench: ft_raw_wrench"
    ):
        small.diagnose(small.model_of(), log, Metrology(sigma=small.SIGMA))


@pytest.mark.parametrize("sessions", [1, 2])
def test_poses_on_a_plate_depend_on_nothing(sessions):
    """The height is measured as that of the plate, and varies by noise alone: so does the gap."""
    model, structured = small.model_of(), []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        q = np.column_stack([rng.uniform(-2, 2, 60), np.full(60, 0.7), np.full(60, -1.1)])
        position = model.predict(q).position + rng.normal(0, small.SIGMA, (60, 3))
        columns = {"actual_q": q, "measured_position": position}
        if sessions > 1:
            columns["session"] = np.repeat(np.arange(sessions), 60 // sessions)
        log = Log("plate.csv", columns, 3)
        (channel,) = diagnose(model, log, Metrology(registered=True, sigma=small.SIGMA)).channels
        assert "measured_position_0" in channel.selection.observation.quantities
        structured.append(channel.structured)
    assert not any(structured)
