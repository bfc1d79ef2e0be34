"""Beside something unknown: what is accused, what is not, and how far values are believed."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import moving_truth as truth
import numpy as np
import pytest
import small_arm as small

from benchmarks.blind.session import Plan
from gapbridge.core.diagnosis import value_stability
from gapbridge.core.diagnosis.causes import considered_of
from gapbridge.core.diagnosis.channels.position import observe as observe_position
from gapbridge.core.diagnosis.channels.wrench import observe
from gapbridge.core.diagnosis.criteria import NEGLIGIBLE_SIZE
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.finding import Check, Withdrawal
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.judgement import (
    Judgement,
    judge,
    judge_geometry,
    significant_alone,
    with_structure_left,
)
from gapbridge.core.diagnosis.selection import rounds
from gapbridge.core.diagnosis.selection.candidate import named_candidates, with_requirement
from gapbridge.core.diagnosis.selection.refit import UnnamedPart, _cluster_covariance, worth
from gapbridge.core.diagnosis.value_stability import links_explain_gap, stable_effects
from gapbridge.core.effects import CATALOGUE, Site, Term
from gapbridge.core.metrology import Metrology

N, ROWS = 6, 70
NOISE = np.repeat([0.1, 0.001], 3)
WAY = np.array([2.0, -3.0, 1.0, 0.05, 0.02, -0.03])
STRETCHED = tuple(
    replace(row, a=row.a + da, d=row.d + dd, alpha=row.alpha + turn)
    for row, da, dd, turn in zip(
        small.NOMINAL.rows, (6e-4, -7e-4, 0.0), (5e-4, 4e-4, 0.0), (7e-4, -6e-4, 0.0), strict=True
    )
)


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    return truth.plant(tmp_path_factory.mktemp("arm"), N, 1)


def wrench_log(plant, error, mass=2.0, declared=True, interval=20.0):
    """Return a log of poses whose sensor reads an ``error(q)`` (N, 6) too much."""
    q = truth.poses(N, ROWS, 5)
    load, still = np.full(ROWS, mass), np.zeros((ROWS, 6))
    wrench = plant.dynamics(q, 0 * q, 0 * q, still, load)[1] + error(q)
    wrench += np.random.default_rng(3).normal(0, 1, wrench.shape) * NOISE
    more = {"payload": load, "payload_cog": np.tile(truth.COG, (ROWS, 1))} if declared else {}
    return truth.log_of(
        N, timestamp=np.arange(ROWS) * interval, actual_q=q, ft_raw_wrench=wrench, **more
    )


def hose(q):
    """Return the pull of a hose that a wrist joint winds up from some angle on."""
    return np.maximum(q[:, 4] - np.quantile(q[:, 4], 0.35), 0.0)[:, None] * WAY


def accused_of(plant, error):
    found = diagnose(plant.model(2.0), wrench_log(plant, error))
    channel = next(c for c in found.channels if c.channel == "wrench")
    return {c.effect for c in channel.causes}, channel


def test_the_mean_of_an_unknown_wrench_is_not_a_bias(plant):
    accused, channel = accused_of(plant, hose)
    assert accused == set()
    assert channel.structured
    assert "actual_q_4" in [name for name, _ in channel.depends_on[:3]]


def test_a_bias_outside_the_span_of_the_unknown_is_accused(plant):
    accused, channel = accused_of(plant, lambda q: hose(q) + 12 * WAY)
    assert accused == {"ft_bias"}
    (cause,) = channel.causes
    # where the hose is slack it is zero, which nobody knows: its mean may be either's
    off = np.array([p.value for p in cause.parameters]) - 12 * WAY
    assert np.all(np.abs(off) < 3 * np.array([p.std for p in cause.parameters]))


def test_gain_and_turn_and_centre_wait_for_a_load(plant):
    """A sensor that reads nothing has nothing to scale or to turn."""

    def beside(mass, effect):
        log = wrench_log(plant, hose, declared=mass > 0)
        model = plant.model(mass)
        observation = observe(model, log, Metrology())
        (own,) = [c for c in named_candidates(model.arm, "wrench") if c.family == effect]
        return with_requirement(observation, own).requires

    for effect in ("ft_gain", "ft_misalignment", "payload_cog"):
        assert (beside(0.0, effect), beside(2.0, effect)) == ("payload", "")
    for effect in ("ft_bias", "ft_drift", "payload"):
        assert beside(0.0, effect) == ""


def test_no_gain_and_no_turn_is_accused_of_a_load_that_is_not(plant):
    bare = replace(plant.model(0.0), payload_cog=np.zeros(3))
    log = wrench_log(plant, lambda q: 0 * hose(q), declared=False)
    channel = next(
        c for c in diagnose(bare, log, withhold=("payload",)).channels if c.channel == "wrench"
    )
    assert not {"ft_gain", "ft_misalignment", "payload_cog"} & {c.effect for c in channel.causes}


def test_what_the_search_found_is_not_told_as_not_excited(plant):
    """A drift of usual size would not show in seconds; one that showed and is withdrawn did."""
    seconds = np.arange(ROWS) * 0.05
    log = wrench_log(plant, lambda q: seconds[:, None] * WAY, interval=0.05)
    found = diagnose(plant.model(2.0), log)
    channel = next(c for c in found.channels if c.channel == "wrench")
    (position,) = (p for p, t in enumerate(channel.selection.terms) if t.effect == "ft_drift")
    judgement = replace(
        channel.judgement, accused=(), withdrawn=((position, Withdrawal(Check.STABLE_VALUE)),)
    )
    held_out = HeldOut(channel.selection)
    told = {c.effect: c for c in considered_of(channel.selection, judgement, held_out)}
    assert told["ft_drift"].excited and told["ft_drift"].withdrawal is not None


def linear(seed, shift):
    """Return white covariance, rows, right side, regions of two columns with cluster effects."""
    rng = np.random.default_rng(seed)
    region = np.repeat(np.arange(24), 10)
    A = np.column_stack([np.ones(240), rng.normal(size=240)])
    b = A @ [1.0, 2.0] + rng.normal(size=240) + shift * rng.normal(size=24)[region]
    residual = b - A @ np.linalg.lstsq(A, b, rcond=None)[0]
    white = np.linalg.inv(A.T @ A) * float(residual @ residual) / 238
    return white, A, b, region


def test_intervals_hold_where_regions_differ():
    """What shifts whole regions makes a mean less sure than that many rows would be."""
    off = []
    for seed in range(150):
        white, A, b, region = linear(seed, 1.0)
        spread = np.sqrt(np.diag(_cluster_covariance(white, A, b, region)))
        off.append((np.linalg.lstsq(A, b, rcond=None)[0] - [1.0, 2.0]) / spread)
        assert np.all(spread >= np.sqrt(np.diag(white)) * (1 - 1e-9))
    inside = np.mean(np.abs(off) < 1.96, axis=0)
    assert np.all(inside > 0.9)
    naive = [
        (np.linalg.lstsq(A, b, rcond=None)[0][0] - 1.0) / np.sqrt(white[0, 0])
        for white, A, b, _ in (linear(seed, 1.0) for seed in range(150))
    ]
    assert np.mean(np.abs(naive) < 1.96) < 0.8


def test_rows_of_the_prior_are_never_left_out():
    white, A, b, region = linear(0, 0.0)
    held = np.vstack([A, [1e6, 0.0]])
    spread = _cluster_covariance(white * 0, held, np.append(b, 1e6), region)
    assert spread[0, 0] < 1e-9


@pytest.fixture(scope="module")
def links():
    """Return the selection of an arm whose links are all a little off."""
    session = small.session_of(0)
    real = replace(small.NOMINAL, rows=STRETCHED)
    log = small.log_of(session, small.readings(real, session))
    found = diagnose(small.model_of(), log, Metrology(registered=True, sigma=small.SIGMA))
    return found.channels[0].selection


def fallen(found, family="link_geometry"):
    """Return a judgement that took everything back, one link among it."""
    arm = small.model_of().arm
    whole = found if found.block else found.with_all_links(arm)
    own = [p for p, c in enumerate(whole.term_index)
           if whole.space.candidates[c].family == family]  # fmt: skip
    return whole, Judgement((), True, 0.0, (), {}, tuple((p, "") for p in own))


def test_all_links_are_accused_where_they_close_the_gap_everywhere(links):
    whole, judgement = fallen(links)
    found, again = judge_geometry(replace(whole, prior={}), judgement, small.model_of().arm)
    assert found.block
    assert {found.terms[p].effect for p in again.accused} >= {"link_geometry"}
    joints = [found.terms[p].site.joint for p in again.accused
              if found.terms[p].effect == "link_geometry"]  # fmt: skip
    assert sorted(joints) == [1, 2]


@pytest.mark.parametrize(
    ("gain", "left", "explains"), [(0.31, 1.7, True), (0.29, 1.7, False), (0.31, 1.9, False)]
)
def test_links_explain_a_gap_only_if_unnamed_functions_do_it_hardly_better(
    links, monkeypatch, gain, left, explains
):
    """A bent laser beam looks like links that close half the gap; as a function it is closed."""

    def held_out(selection, parts):
        return SimpleNamespace(
            possible=True, shrink=lambda *_: SimpleNamespace(interval=(gain, 0.9)),
            rms=lambda _: left if selection is whole else 1.0,
        )  # fmt: skip

    whole = replace(links)
    monkeypatch.setattr(value_stability, "HeldOut", held_out)
    assert links_explain_gap(whole, links, ()) == explains


@pytest.mark.parametrize("effect", ["cross_coupling", "backlash"])
def test_links_that_close_no_gap_are_not_accused(effect):
    found = small.diagnosed(effect).channels[0].selection
    whole, judgement = fallen(found)
    assert not links_explain_gap(whole, found, ())
    found, again = judge_geometry(replace(whole, prior={}), judgement, small.model_of().arm)
    assert again is judgement
    assert not found.block


def test_a_tool_point_is_accused_with_the_links_if_it_helps_in_new_regions(monkeypatch):
    session = small.session_of(0)
    off = np.array([2e-3, -1e-3, 3e-3])
    real = replace(small.NOMINAL, rows=STRETCHED, tool_position=small.TOOL + off)
    log = small.log_of(session, small.readings(real, session))
    result = diagnose(small.model_of(), log, Metrology(registered=True, sigma=small.SIGMA))
    whole, _ = fallen(result.channels[0].selection)
    own = whole.space.candidates
    point = [c for c, k in enumerate(own) if k.family == "tool_frame"]
    lines = [c for c, k in enumerate(own) if k.periodic][:1]
    requested = []

    def strengths(_, accused):  # beside an unknown that moves the tool its point is the least sure
        requested.append(set(accused))
        return np.array([0.0 if c in point else 0.5 + (len(accused) < 3) for c in accused])

    monkeypatch.setattr(value_stability._UnnamedFunctions, "strengths", strengths)
    monkeypatch.setattr(
        value_stability._GapClosure, "needs_any", lambda *_: False
    )  # by their strengths alone
    zero = [c for c, k in enumerate(own) if k.family == "backlash"][:1]
    kept, *_ = stable_effects(whole, [*point, *lines, *zero])
    assert requested[1] > {*point}  # the others are judged with the point, not with its gap
    assert {*kept} >= {*point}
    found, *_ = stable_effects(replace(whole, prior={}), point)
    assert found == []  # no links are a cause


def test_the_links_prior_is_estimated_again_for_the_remaining_terms(links):
    whole, _ = fallen(links)
    wrong = replace(whole, prior={c: 8 * own for c, own in whole.prior.items()})
    sized = wrong.with_prior_for(whole.best.chosen)
    assert all(np.array_equal(sized.prior[c], own) for c, own in whole.prior.items())
    assert whole.with_prior_for(whole.best.chosen) is whole


@pytest.mark.parametrize(
    ("effect", "order", "values", "spread", "sure"),
    [
        # three numbers whose sum is known, and of none of them anything
        ("link_geometry", None, (1.0, 1.0, 1.0), np.ones((3, 3)) * 0.98 + 0.02 * np.eye(3), False),
        ("link_geometry", None, (1.0, -1.0, 0.0), 0.98 + 0.02 * np.eye(3), False),
        ("link_geometry", None, (4.0, 4.0, 4.0), 0.2 + 0.8 * np.eye(3), True),
        # of a line the amplitude, not one of its parts
        ("transmission_error", 17.0, (2.9, 2.9), 0.5 * np.eye(2), True),
        ("transmission_error", 17.0, (2.0, 2.0), np.array([[1.0, 0.9], [0.9, 1.0]]), False),
        # a stiffness curve on the bound of its curvature, where that has no deviation
        ("stiffness_nonlinearity", None, (6e-6, 0.0), np.diag([1e-14, 0.0]), False),
        ("stiffness_nonlinearity", None, (6e-6, 1e-4), np.diag([1e-14, 1e-10]), True),
    ],
)
def test_a_significant_term_has_a_significant_parameter(effect, order, values, spread, sure):
    assert (worth(Term(effect, Site(2, order), values), spread) >= 1) is sure


@pytest.fixture(scope="module")
def beside_a_single_link():
    """Return the selection of an arm all off, zeros too, and a judgement that accuses one link."""
    session = small.session_of(0)
    real = replace(small.REAL["joint_offset"], rows=STRETCHED)
    log = small.log_of(session, small.readings(real, session))
    found = diagnose(small.model_of(), log, Metrology(registered=True, sigma=small.SIGMA))
    whole, _ = fallen(found.channels[0].selection)
    one = next(p for p, c in enumerate(whole.term_index)
               if whole.space.candidates[c].family == "link_geometry")  # fmt: skip
    return replace(whole, prior={}), Judgement((one,), True, 0.0, (), {}, ())


def test_all_links_replace_a_single_one_that_leaves_a_large_residual(beside_a_single_link):
    alone, judgement = beside_a_single_link
    found, again = judge_geometry(alone, judgement, small.model_of().arm)
    assert {found.terms[p].effect for p in again.accused} == {"link_geometry", "joint_offset"}


def test_a_single_link_that_closes_the_gap_is_kept(beside_a_single_link):
    alone, judgement = beside_a_single_link
    enough = replace(judgement, structured=False)
    assert judge_geometry(alone, enough, small.model_of().arm) == (alone, enough)


def test_a_value_far_below_its_usual_size_is_no_accusation():
    found = small.diagnosed("backlash").channels[0].selection
    (term,), (c,) = found.terms, found.term_index
    usual = found.space.candidates[c].parameters[0].scale
    for size, kept in (
        (0.5 * NEGLIGIBLE_SIZE * usual, False),
        (2 * NEGLIGIBLE_SIZE * usual, True),
    ):
        small_one = replace(
            found, terms=(term.with_values(np.array([size])),),
            covariance=(np.array([[(size / 50) ** 2]]),),
        )  # fmt: skip
        judged = judge(small_one, HeldOut(found))
        assert (len(judged.accused) == 1) is kept
        assert kept or judged.withdrawn == ((0, Withdrawal(Check.USUAL_SIZE)),)


def test_a_term_not_significant_with_unnamed_functions_is_withdrawn():
    found = small.diagnosed("backlash").channels[0].selection
    judgement = judge(found, HeldOut(found))
    arm = small.model_of().arm
    assert significant_alone(found, judgement, HeldOut(found), arm)[1] is judgement
    rows = len(found.space.y)
    # an unnamed function that does the very same as the accused
    twin = found.space.columns(found.term_index)
    unknown = UnnamedPart(twin, np.full(twin.shape[1], np.inf), np.arange(rows) // 3 % 20)
    _, judged = significant_alone(
        found, replace(judgement, unnamed_part=unknown), HeldOut(found), arm
    )
    assert judged.accused == ()
    assert with_structure_left(found, judged).structured
    assert [p for p, _ in judged.withdrawn] == [0]


def test_every_member_that_waits_for_another_names_one_of_its_channel():
    for effect in CATALOGUE.values():
        if effect.identifiable_with is not None:
            other = CATALOGUE[effect.identifiable_with.effect]
            assert set(effect.channels) & set(other.channels)


def test_a_term_removed_by_the_refit_is_replaced_by_another(monkeypatch):
    """Without reversals play is an offset: where the one has no value, the other is found."""
    one_sided = small.session_of(3, Plan(poses=60, both_sides=False))
    real = small.turned(2, lambda s, q: np.full(len(q), -4.5e-4))
    log = small.log_of(one_sided, small.readings(real, one_sided, 3))
    observation = observe_position(
        small.model_of(), log, Metrology(registered=True, sigma=small.SIGMA)
    )
    (first,) = rounds.select(observation, small.model_of()).terms

    def worthless(term, spread):
        return 0.0 if term.effect == first.effect else worth(term, spread)

    monkeypatch.setattr(rounds, "worth", worthless)
    (instead,) = rounds.select(observation, small.model_of()).terms
    assert {first.effect, instead.effect} == {"joint_offset", "backlash"}
    assert instead.site.joint == 2
