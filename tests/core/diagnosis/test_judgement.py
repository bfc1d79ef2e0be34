"""The judgement: ties are reported, weak accusations withdrawn, causes and losers accounted for."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import small_arm as small
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.blind.session import Plan
from gapbridge.bridge.document.findings import considered_text
from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis import judgement as judging
from gapbridge.core.diagnosis.causes import Outcome, causes_of, considered_of, probability
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.finding import (
    ChannelFinding,
    Check,
    NotAccused,
    ParameterNote,
    ParameterState,
    Withdrawal,
)
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.judgement import (
    Judgement,
    judge,
    pure_error,
    significant_alone,
    with_structure_left,
)
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.effects import CATALOGUE, Site, Term, effect_named
from gapbridge.core.metrology import Metrology

LOGS = ("none", "backlash", "tool_frame", "cross_coupling", "thermal_drift")
GAINING = SimpleNamespace(
    possible=True, shrink=lambda *_: SimpleNamespace(interval=(0.1, 0.2))
)  # what is held out confirms everything


def channel_of(effect: str):
    return small.diagnosed(effect).channels[0]


@pytest.mark.parametrize("effect", LOGS)
def test_every_effect_of_the_catalogue_is_a_cause_or_reported_why_not(effect):
    channel = channel_of(effect)
    accused = {c.effect for c in channel.causes}
    considered = [c.effect for c in channel.considered]
    assert len(considered) == len(set(considered))
    assert accused.isdisjoint(considered)
    of_the_channel = {k for k, e in CATALOGUE.items() if "position" in e.channels}
    assert accused | set(considered) == of_the_channel
    assert all(considered_text(c) for c in channel.considered)
    assert all(0 <= c.probability <= 1 for c in channel.considered)


@pytest.mark.parametrize("effect", LOGS)
def test_every_term_is_accused_or_withdrawn(effect):
    channel = channel_of(effect)
    withdrawn = {position for position, _ in channel.judgement.withdrawn}
    accused = set(channel.judgement.accused)
    assert accused.isdisjoint(withdrawn)
    assert accused | withdrawn == set(range(len(channel.selection.terms)))
    named = sorted(t.effect for c in channel.causes for t in c.terms)
    assert named == sorted(channel.selection.terms[p].effect for p in accused)


def test_an_effect_not_stable_with_residual_structure_is_withdrawn():
    found = small.diagnosed("cross_coupling")
    (channel,) = found.channels
    assert channel.judgement.structured
    assert channel.judgement.accused == ()
    for position, reason in channel.judgement.withdrawn:
        effect = channel.selection.terms[position].effect
        facts = [finding.fact for finding in found.findings if isinstance(finding, ChannelFinding)]
        assert any(
            isinstance(f, NotAccused) and (f.term.effect, f.reason) == (effect, reason)
            for f in facts
        )
        assert next(c for c in channel.considered if c.effect == effect).withdrawal == reason
    assert found.model.terms == small.model_of().terms  # nothing withdrawn reaches the model


def test_a_residual_above_the_stated_noise_is_structure():
    session = small.session_of(0)
    log = small.log_of(session, small.readings(small.NOMINAL, session))
    stated = np.sqrt(small.FLOOR**2 - small.SIGMA**2)
    verdicts = [
        diagnose(
            small.model_of(), log,
            Metrology(registered=True, sigma=sigma, repeatability=repeatability),
        ).verdict
        for sigma, repeatability in ((small.SIGMA, stated), (5e-6, 5e-6))
    ]  # fmt: skip
    assert verdicts == ["no_gap", "unexplained"]


def test_a_term_without_held_out_gain_is_withdrawn():
    selection = channel_of("backlash").selection
    rng = np.random.default_rng(0)
    drawn = rng.normal(size=len(selection.unprojected.target))
    noise = replace(selection, unprojected=replace(selection.unprojected, target=drawn))
    kept = judge(selection, HeldOut(selection))
    assert len(kept.accused) == 1
    judged = judge(selection, HeldOut(noise))
    assert judged.accused == ()
    assert [why for _, why in judged.withdrawn] == [Withdrawal(Check.HELD_OUT_GAIN)]


def test_structure_is_what_the_remaining_accused_terms_leave():
    """Terms withdrawn later leave their part; it has a p-value and quantities."""
    channel = channel_of("backlash")
    given = replace(channel.judgement, structured=False, p_value=0.55, depends_on=())
    assert with_structure_left(channel.selection, given) == given
    fewer = with_structure_left(channel.selection, replace(given, accused=()))
    assert fewer.structured
    assert fewer.p_value is not None
    assert fewer.p_value < 1e-3
    assert fewer.depends_on[0][0] == "approach_1"


def test_outliers_that_the_accused_terms_fit_are_no_structure():
    channel = channel_of("joint_offset")
    kept = channel.selection.kept.copy()
    kept[::5] = False
    fewer = replace(channel.selection, kept=kept)
    accused = [fewer.term_index[p] for p in channel.judgement.accused]
    assert accused
    assert judging._outlier_share(fewer, accused) == 0
    off = fewer.observation.measured + 1e-2 * ~kept[:, None]
    bad = replace(fewer, observation=replace(fewer.observation, measured=off))
    assert judging._outlier_share(bad, accused) == pytest.approx(0.2)


@pytest.mark.parametrize(("share", "structured"), [(0.1, False), (0.11, True)])
def test_more_than_a_tenth_of_outliers_is_structure(monkeypatch, share, structured):
    monkeypatch.setattr(judging, "_outlier_share", lambda *_: share)
    selection = channel_of("joint_offset").selection
    assert judge(selection, HeldOut(selection)).structured == structured


def test_a_term_is_accused_only_beside_the_effect_that_it_needs():
    candidates = [SimpleNamespace(family=name, requires=needs)
                  for name, needs in (("friction", ""), ("fading", "friction"))]  # fmt: skip
    selection = SimpleNamespace(space=SimpleNamespace(candidates=candidates))
    assert judging._missing_requirement(selection, [1]) == [1]
    assert judging._missing_requirement(selection, [0, 1]) == []


def test_a_value_on_its_bound_is_no_accusation():
    selection = channel_of("backlash").selection
    (term,), (c,) = selection.terms, selection.term_index
    candidate = selection.space.candidates[c]
    bounded = tuple(replace(p, upper=term.values[0]) for p in candidate.parameters)
    candidates = list(selection.space.candidates)
    candidates[c] = replace(candidate, parameters=bounded)
    space = replace(selection.space, candidates=tuple(candidates))
    judged = judge(replace(selection, space=space), HeldOut(selection))
    assert judged.accused == ()
    assert [why for _, why in judged.withdrawn] == [Withdrawal(Check.INSIDE_BOUNDS)]


@pytest.mark.parametrize(("sigmas", "stays"), [(0.5, False), (40.0, True)])
def test_a_value_that_may_as_well_be_none_is_no_accusation(sigmas, stays):
    selection = channel_of("backlash").selection
    (term,) = selection.terms
    spread = np.array([[(term.values[0] / sigmas) ** 2]])
    judged = judge(replace(selection, covariance=(spread,)), HeldOut(selection))
    assert (len(judged.accused) == 1) is stays


def test_a_known_effect_is_accused_besides_an_unknown_one_that_is_reported():
    """Play in one joint, and another that a third carries along."""
    session = small.session_of(5)
    errors = [small.REAL[e].angle_errors for e in ("backlash", "cross_coupling")]
    real = replace(small.NOMINAL, angle_errors=(*errors[0], *errors[1]))
    log = small.log_of(session, small.readings(real, session, 5))
    found = diagnose(small.model_of(), log, Metrology(registered=True, sigma=small.SIGMA))
    (channel,) = found.channels
    assert found.verdict == "partly_explained"
    assert [(c.effect, c.joints) for c in channel.causes] == [("backlash", (2,))]
    assert channel.structured
    assert channel.p_value < 0.05
    assert "actual_q_1" in [name for name, _ in channel.depends_on[:3]]
    (parameter,) = channel.causes[0].parameters
    assert abs(parameter.value - 9e-4) < 3.5 * parameter.std


def test_a_tie_names_the_other_and_leaves_the_strangers_out():
    one_sided = small.session_of(3, Plan(poses=60, both_sides=False))
    real = small.turned(2, lambda s, q: np.full(len(q), -4.5e-4))
    log = small.log_of(one_sided, small.readings(real, one_sided, 3))
    found = diagnose(small.model_of(), log, Metrology(registered=True, sigma=small.SIGMA))
    (cause,) = found.channels[0].causes
    assert {cause.effect, *cause.indistinguishable_from} >= {"joint_offset", "backlash"}
    assert cause.effect not in cause.indistinguishable_from
    assert "thermal_drift" not in cause.indistinguishable_from
    for clear in ("backlash", "tool_frame", "thermal_drift"):
        assert channel_of(clear).causes[0].indistinguishable_from == ()


@pytest.mark.parametrize(("joint", "tie"), [(3, ("tool_frame",)), (2, ())])
def test_the_last_joints_zero_is_a_tie_with_the_tool(joint, tie):
    """Both move the TCP about the last axis, by the same in all poses."""
    session = small.session_of(0)
    real = small.turned(joint, lambda s, q: np.full(len(q), 8e-4))
    log = small.log_of(session, small.readings(real, session))
    found = diagnose(small.model_of(), log, Metrology(registered=True, sigma=small.SIGMA))
    (cause,) = found.channels[0].causes
    assert (cause.effect, cause.joints) == ("joint_offset", (joint,))
    assert cause.indistinguishable_from == tie


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 999), sigma=st.floats(1e-6, 1e-2), pairs=st.integers(30, 60))
def test_repeats_show_the_noise_whatever_the_poses_are_off_by(seed, sigma, pairs):
    rng = np.random.default_rng(seed)
    groups = np.repeat(np.arange(pairs), 3)
    noise = rng.normal(0, sigma, (3 * pairs, 3))
    poses = rng.normal(0, 1, (pairs, 3))[groups]
    variance, freedom = pure_error(noise + poses, groups)
    assert freedom == 6 * pairs
    assert np.sqrt(variance) == pytest.approx(sigma, rel=0.25)
    assert pure_error(poses, groups)[0] == pytest.approx(0, abs=1e-20)
    assert pure_error(noise, np.arange(3 * pairs)) == (0.0, 0)
    session = np.tile(np.arange(3), pairs)  # each pose once a session: no repeats
    assert pure_error(noise, groups, session) == (0.0, 0)


@pytest.mark.parametrize("effect", ["backlash", "tool_frame", "thermal_drift"])
def test_a_cause_that_is_needed_is_more_probable_than_not(effect):
    channel = channel_of(effect)
    assert 0.99 < channel.causes[0].probability <= 1
    own = set(channel.selection.best.chosen)
    assert probability(channel.selection, own) == channel.causes[0].probability


def test_an_effect_that_scores_well_alone_is_not_probable_given_the_cause():
    channel = channel_of("backlash")
    alone = {c.effect: c for c in channel.considered}
    assert max(c.shrink_alone or 0 for c in alone.values()) < channel.causes[0].shrink_alone
    assert all(c.probability < 0.5 for c in alone.values())


def test_a_parameter_on_its_bound_is_reported():
    channel = channel_of("backlash")
    selection = channel.selection
    (term,) = selection.terms
    flat = replace(selection, terms=(term.with_values(np.zeros(1)),))
    note = ParameterNote(ParameterState.ON_BOUND, "backlash_2", 0.0, "rad")
    for chosen, notes in ((selection, ()), (flat, (note,))):
        (cause,) = causes_of(chosen, channel.judgement, HeldOut(chosen), small.model_of().arm)
        assert cause.notes == notes


def test_what_a_log_cannot_show_reports_what_it_needs():
    rigid = {c.effect: c for c in channel_of("none").considered}
    payload = rigid["payload"]  # positions of a rigid model do not show it
    assert (payload.excited, payload.probability, payload.shrink_alone) == (False, 0.0, None)
    assert payload.outcome is Outcome.NOT_EXCITED
    assert payload.needs
    assert rigid["joint_offset"].excited
    channel = channel_of("none")
    held = HeldOut(channel.selection)
    reported = considered_of(channel.selection, channel.judgement, held, ("payload",))
    assert "payload" not in {c.effect for c in reported}
    cold = small.session_of(0)
    without = small.log_of(
        cold, small.readings(small.NOMINAL, cold), joint_temperatures=None, approach=None
    )
    found = diagnose(small.model_of(), without, Metrology(registered=True, sigma=small.SIGMA))
    thermal = {c.effect: c for c in found.channels[0].considered}["thermal_drift"]
    assert (thermal.excited, thermal.shrink_alone) == (False, None)


def test_all_links_stay_a_cause_of_which_no_single_number_is_significant(monkeypatch):
    """Thirty to a hundred poses of a UR10 or a Motoman: the links halve the gap of every region."""
    terms = (
        Term("joint_offset", Site(1), (1.0,)),
        Term("link_geometry", Site(2), (2e-4, 2e-4, 2e-4)),
    )
    found = SimpleNamespace(
        terms=terms, covariance=[np.eye(1) * 1e-4, 1e-8 * np.eye(3)], term_index=(7, 8),
        prior={8: np.full(3, 5e-4)}, block=(8,), observation=SimpleNamespace(channel="position"),
        space=SimpleNamespace(candidates={
            c: SimpleNamespace(effect=effect_named(t.effect), family=t.effect)
            for c, t in zip((7, 8), terms, strict=True)
        }),
    )  # fmt: skip
    for name in ("_in_geometry", "is_link", "judged_alone", "implausible_parameters"):
        setattr(found, name, partial(getattr(Selection, name), found))
    monkeypatch.setattr(judging, "refitted_alone", lambda *_: found)
    given = Judgement((0, 1), False, None, (), {}, ())
    assert significant_alone(found, given, GAINING, None) == (found, given)


@pytest.mark.parametrize(("value", "alone"), [(2e-4, [0]), (0.0, [0, 1, 2])])
def test_links_of_which_nothing_is_left_are_no_cause(value, alone):
    """30 % of a tracker's positions in another order: all numbers of the links held nominal."""
    terms = [
        Term("joint_offset", Site(1), (1.0,)),
        *(Term("link_geometry", Site(j), (0.0, value, 0.0)) for j in (2, 3)),
    ]
    covariance = [np.eye(1) * 1e-4, *[np.diag([0.0, 1e-8, 0.0])] * 2]
    found = SimpleNamespace(terms=terms, covariance=covariance, is_link=lambda p: p > 0)
    assert Selection.judged_alone(found, (0, 1, 2)) == alone


@pytest.mark.parametrize(
    ("lengths", "deviation", "nominal"),
    [
        ((-45.5e-3, 45.6e-3), 14e-3, {1: [False, True, False]}),  # of a UR5, from 20 poses
        ((-45.6e-3, 45.5e-3), 14e-3, {0: [False, True, False]}),
        ((-45.5e-3, 45.6e-3), 7e-3, {}),  # six sigmas: a wrong drawing
        ((1.4e-3, -1.4e-3), 1e-3, {}),
    ],
)
def test_a_single_links_length_far_from_machining_has_to_be_significant(
    lengths, deviation, nominal
):
    """Only the sum of two parallel links' offsets is well determined; one is tried at a time."""
    link = effect_named("link_geometry")
    numbers = link.parameters(builtin_arm("ur10e"), Site(1))[:3]
    first, second = lengths
    found = SimpleNamespace(
        terms=[
            Term("link_geometry", Site(3), (1e-4, first, 1e-3)),
            Term("link_geometry", Site(4), (1e-4, second, 1e-3)),
        ],
        covariance=[np.diag([1e-8, deviation**2, 1e-7])] * 2, term_index=(0, 1), prior={},
        observation=SimpleNamespace(channel="position"),
        space=SimpleNamespace(candidates=[SimpleNamespace(effect=link, parameters=numbers)] * 2),
    )  # fmt: skip
    far = Selection.implausible_parameters(found, (0, 1))
    assert {c: mask.tolist() for c, mask in far.items()} == nominal


@pytest.mark.parametrize(
    ("deviation", "nominal"), [(47e-3, {0: [False, False, True]}), (29e-3, {}), (10e-3, {})]
)
def test_an_axis_of_the_tool_that_is_not_identifiable_is_the_cells(deviation, nominal):
    """The tool of a UR10 stood 20 mm off along its axis, with a standard deviation of 47 mm."""
    tool = SimpleNamespace(effect=effect_named("tool_frame"), scales=np.full(3, 1e-3))
    found = SimpleNamespace(
        terms=[Term("tool_frame", Site(), (1e-4, 5e-4, -0.0197, 0.0, 0.0, 0.0))],
        covariance=[np.diag([1e-8, 1e-8, deviation**2])], term_index=(0,), prior={},
        observation=SimpleNamespace(channel="position"),
        space=SimpleNamespace(candidates=[tool]),
    )  # fmt: skip
    far = Selection.implausible_parameters(found, (0,))
    assert {c: mask.tolist() for c, mask in far.items()} == nominal


@pytest.mark.parametrize(("offset", "stays"), [(2.9e-4, (0, 1)), (3.1e-4, (0, 1, 2))])
def test_each_joint_zero_of_the_links_has_to_be_significant(monkeypatch, offset, stays):
    """Series of a UR10 and a Motoman named all joints, with not one number over three sigmas."""
    terms = (
        Term("link_geometry", Site(2), (1e-3, 1e-3, 1e-3)),
        Term("joint_offset", Site(1), (1e-3,)),
        Term("joint_offset", Site(2), (offset,)),
    )
    own = (effect_named(t.effect) for t in terms)
    found = SimpleNamespace(
        terms=terms, covariance=[1e-8 * np.eye(len(t.values)) for t in terms], term_index=(0, 1, 2),
        prior=dict.fromkeys(range(3), np.full(3, 5e-4)), block=(0, 1, 2),
        observation=SimpleNamespace(channel="position"),
        space=SimpleNamespace(
            candidates=[SimpleNamespace(effect=e, family=e.identifier) for e in own]
        ),
    )  # fmt: skip
    for name in ("_in_geometry", "is_link", "judged_alone", "implausible_parameters"):
        setattr(found, name, partial(getattr(Selection, name), found))
    monkeypatch.setattr(judging, "refitted_alone", lambda *_: found)
    _, judgement = significant_alone(
        found, Judgement((0, 1, 2), False, None, (), {}, ()), GAINING, None
    )
    assert judgement.accused == stays


@pytest.mark.parametrize(
    ("first_sigma", "low", "stays"),
    [(1.0, -0.06, ()), (1.0, 0.1, (1,)), (1e-5, -0.06, (0, 1))],
)
def test_what_gains_beside_a_withdrawn_term_only_is_withdrawn_too(
    monkeypatch, first_sigma, low, stays
):
    """A UR5 of 20 poses: base_compliance beside a link that is not significant. Nothing is judged
    twice where nothing was withdrawn."""
    terms = tuple(Term("joint_offset", Site(j), (1e-3,)) for j in (1, 2))
    own = SimpleNamespace(effect=effect_named("joint_offset"), family="joint_offset")
    found = SimpleNamespace(
        terms=terms, covariance=[np.eye(1) * first_sigma**2, np.eye(1) * 1e-10], term_index=(0, 1),
        block=(), observation=SimpleNamespace(channel="position"),
        space=SimpleNamespace(candidates=[own, own]), judged_alone=list,
        implausible_parameters=lambda _: {},
    )  # fmt: skip
    monkeypatch.setattr(judging, "refitted_alone", lambda *_: found)
    held_out = SimpleNamespace(
        possible=True, shrink=lambda *_: SimpleNamespace(interval=(low, 0.4))
    )
    given = Judgement((0, 1), False, None, (), {}, ())
    _, judgement = significant_alone(found, given, held_out, None)
    assert judgement.accused == stays
    reasons = {p: why.failed for p, why in judgement.withdrawn}
    assert reasons.get(1) == (None if 1 in stays else Check.HELD_OUT_GAIN)


@pytest.mark.parametrize(("each", "gainless"), [(False, []), (True, [0])])
def test_of_the_links_every_effect_has_to_gain_by_itself_on_all_rows(each, gainless):
    """Two first moments of 0.07 kg m that cancel each other were a cause beside all friction."""
    kinds = [SimpleNamespace(family=f) for f in ("link_cog", "coulomb_friction")]
    found = SimpleNamespace(
        block=(0, 1), observation=SimpleNamespace(channel="torque"),
        space=SimpleNamespace(candidates=kinds),
    )  # fmt: skip

    def shrink(_, without):
        return SimpleNamespace(interval=(0.8 if 1 not in without else -0.001, 0.9))

    held_out = SimpleNamespace(possible=True, shrink=shrink)
    assert judging.without_gain(found, [0, 1], held_out, each=each) == gainless


def test_links_that_gain_only_by_what_is_then_held_nominal_are_no_cause(monkeypatch):
    """A column that bends below a Doosan: 42 % by an implausible length, nothing without it."""
    link = SimpleNamespace(effect=effect_named("link_geometry"), family="link_geometry")
    found = SimpleNamespace(
        terms=(Term("link_geometry", Site(2), (1e-3, 1e-3, 1e-3)),), covariance=[np.eye(3)],
        term_index=(4,), block=(4,), judged_alone=lambda _: [],
        observation=SimpleNamespace(channel="position"),
        space=SimpleNamespace(candidates={4: link}),
        implausible_parameters=lambda _: {4: [True]}, with_nominal=lambda _: held,
    )  # fmt: skip
    held = SimpleNamespace(**vars(found) | {"implausible_parameters": lambda _: {}})
    monkeypatch.setattr(judging, "refitted_alone", lambda selection, *_: selection)

    gainless = SimpleNamespace(
        possible=True, shrink=lambda *_: SimpleNamespace(interval=(-0.03, 0.04))
    )
    monkeypatch.setattr(judging, "HeldOut", lambda _: gainless)
    given = Judgement((0,), True, None, (), {}, ())
    _, judgement = significant_alone(found, given, GAINING, None)
    assert judgement.accused == ()


@pytest.mark.parametrize(("spread", "held"), [(9e-3, True), (5e-3, False)])
def test_a_twist_far_outside_the_prior_has_to_be_significant(monkeypatch, spread, held):
    """A WAM's wrist: 41 mrad beside links of 2 mrad, where its joints turn each other. A UR5's
    twist, as far off, is sure."""
    sizes, prior = np.array([1e-3, 1e-3, 41e-3]), np.full(3, 8e-3)
    found = SimpleNamespace(
        terms=(Term("link_geometry", Site(5), tuple(sizes)),), term_index=(4,), block=(4,),
        covariance=[np.diag([1e-4, 1e-4, spread]) ** 2], prior={4: prior}, nominal={},
        is_link=lambda p: True, _in_geometry=lambda p: True,
        observation=SimpleNamespace(channel="position"),
        space=SimpleNamespace(candidates={4: SimpleNamespace(family="link_geometry")}),
    )  # fmt: skip
    again = SimpleNamespace(
        **vars(found) | {"terms": (Term("link_geometry", Site(5), (1e-3, 1e-3, 0.0)),)}
    )
    for own in (found, again):
        own.judged_alone = partial(Selection.judged_alone, own)
        own.implausible_parameters = partial(Selection.implausible_parameters, own)
    requested = []

    def with_nominal(numbers):
        requested.append({c: far.tolist() for c, far in numbers.items()})
        return again

    found.with_nominal = with_nominal
    monkeypatch.setattr(judging, "HeldOut", lambda _: GAINING)
    monkeypatch.setattr(judging, "refitted_alone", lambda selection, *_: selection)
    selection, judgement = significant_alone(
        found, Judgement((0,), False, None, (), {}, ()), GAINING, None
    )
    assert selection is (again if held else found)
    assert requested == ([{4: [False, False, True]}] if held else [])
    assert judgement.accused == (0,)
