"""All rows of a long log decide on what a search on some of them left open."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import small_arm as small

from gapbridge.core.diagnosis.all_rows import refit_on_all_rows as all_rows
from gapbridge.core.diagnosis.all_rows.refit_on_all_rows import (
    RefitsAtOnce,
    accused_on_all_rows,
    fitted_on_all_rows,
    with_undecided_terms,
)
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.judgement import NOT_SIGNIFICANT, Judgement, judge
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.effects import Site, Term, effect_named

REFITS = RefitsAtOnce(small.model_of(), False)


@pytest.fixture(scope="module")
def searched():
    selection = small.diagnosed("backlash").channels[0].selection
    return selection, judge(selection, HeldOut(selection))


@pytest.mark.slow
def test_covariances_with_an_unknown_effect_include_the_scatter_among_regions():
    """One accusation falls: the others' intervals were those of white noise from then on."""
    selection = small.diagnosed("cross_coupling").channels[0].selection
    everything = tuple(range(len(selection.terms)))
    white, _ = on_all(selection, Judgement(everything, True, 0.0, (), {}, ()))
    beside = RefitsAtOnce(small.model_of(), True).alone(white, everything)
    for p in everything:
        assert beside.covariance[p].item() > 1.5 * white.covariance[p].item()


def on_all(selection, judgement):
    """Return the selection on all rows, and its held-out figures."""
    whole = fitted_on_all_rows(selection, judgement, selection.observation, small.model_of())
    return whole, HeldOut(whole)


def withdrawn_as_vague(judgement, position):
    rest = tuple(p for p in judgement.accused if p != position)
    return replace(
        judgement, accused=rest, withdrawn=(*judgement.withdrawn, (position, NOT_SIGNIFICANT))
    )


def test_a_term_not_significant_on_some_rows_is_accused_if_significant_on_all(searched):
    selection, judgement = searched
    position = judgement.accused[0]
    requested = with_undecided_terms(withdrawn_as_vague(judgement, position))
    assert requested.undecided == (position,)
    whole, held = on_all(selection, requested)
    _, decided = accused_on_all_rows(whole, requested, held, REFITS)
    assert position in decided.accused
    assert position not in dict(decided.withdrawn)


def test_a_term_not_significant_on_all_rows_is_withdrawn(searched):
    selection, judgement = searched
    position = judgement.accused[0]
    requested = with_undecided_terms(withdrawn_as_vague(judgement, position))
    whole, held = on_all(selection, requested)
    covariance = list(whole.covariance)
    value = np.array(whole.terms[position].values[: len(covariance[position])])
    covariance[position] = np.diag((value / 4.0) ** 2)  # enough for a word, not for an accusation
    unsure = replace(whole, covariance=tuple(covariance))
    _, decided = accused_on_all_rows(unsure, requested, held, REFITS)
    assert position not in decided.accused
    assert dict(decided.withdrawn)[position] == NOT_SIGNIFICANT
    _, kept = accused_on_all_rows(unsure, judgement, held, REFITS)
    assert position in kept.accused  # what some rows were sure of is not asked again


def each_by_itself(alone):
    """Return refits that follow nothing to first order."""
    return SimpleNamespace(alone=alone, linearised=lambda *_: None)


class OnAllRows:
    """Links and a joint's zero among them as all rows show them."""

    def __init__(self, lengths, zero):
        self.terms = (Term("link_geometry", Site(2), lengths), Term("joint_offset", Site(2), zero))
        self.covariance = [1e-8 * np.eye(3), 1e-8 * np.eye(1)]
        self.covariance[0][1, 1] = 9e-4  # 30 mm: nearly parallel axes do not show it
        self.term_index = (0, 1)
        self.prior = {0: np.full(3, 5e-4), 1: np.full(1, 1e-3)}
        self.observation = SimpleNamespace(channel="position")
        own = [SimpleNamespace(effect=effect_named(t.effect)) for t in self.terms]
        self.space = SimpleNamespace(candidates=own)

    _in_geometry, is_link = Selection._in_geometry, Selection.is_link
    judged_alone = Selection.judged_alone
    implausible_parameters = Selection.implausible_parameters

    def with_nominal(self, numbers):
        (held,) = numbers.values()
        return OnAllRows(tuple(np.where(held, 0.0, self.terms[0].values)), self.terms[1].values)


def test_a_length_not_identifiable_on_all_rows_is_kept_nominal():
    """9,529 rows of a UR10 named a link of 71 mm +- 37 mm under a prior of 0.5 mm."""
    found = OnAllRows((1e-3, 0.071, 1e-3), (5e-4,))
    requested = Judgement((0, 1), True, 0.0, (), {}, ())
    selection, decided = all_rows._significant(
        found, requested, each_by_itself(lambda selection, _: selection)
    )
    assert selection.terms[0].values == (1e-3, 0.0, 1e-3)
    assert decided.accused == (0, 1)


def test_remaining_terms_are_tested_again_after_a_withdrawal(monkeypatch):
    """Without its lines a UR10's link took 55 mm +- 18 mm, after all had been sure."""
    found = OnAllRows((1e-3, 1e-3, 1e-3), (5e-4,))
    without_line = OnAllRows((1e-3, 0.055, 1e-3), (5e-4,))
    monkeypatch.setattr(all_rows, "not_constant", lambda *_: {1: "actual_q_1"})
    monkeypatch.setattr(all_rows, "ties_of", lambda *_: {})

    def alone(selection, accused):
        return selection if 1 in accused or selection is not found else without_line

    requested = Judgement((0, 1), True, 0.0, (), {}, ())
    selection, decided = accused_on_all_rows(
        found, requested, SimpleNamespace(possible=False), each_by_itself(alone)
    )
    assert decided.accused == (0,)
    assert selection.terms[0].values == (1e-3, 0.0, 1e-3)


def test_on_all_rows_every_effect_has_to_gain_by_itself(monkeypatch):
    found = OnAllRows((1e-3, 1e-3, 1e-3), (5e-4,))
    monkeypatch.setattr(all_rows, "not_constant", lambda *_: {})
    monkeypatch.setattr(all_rows, "ties_of", lambda *_: {})
    monkeypatch.setattr(all_rows, "without_gain", lambda *_, each=False: [1] if each else [])
    requested = Judgement((0, 1), True, 0.0, (), {}, ())
    _, decided = accused_on_all_rows(
        found, requested, SimpleNamespace(possible=True), each_by_itself(lambda s, _: s)
    )
    assert decided.accused == (0,)


@pytest.mark.parametrize(("zero", "stays"), [(2.9e-4, (0,)), (3.1e-4, (0, 1))])
def test_an_undecided_joint_zero_of_the_links_needs_three_sigmas(zero, stays):
    """It has a prior: without it the links of a UR10 stood for 0.57 mrad +- 0.13 mrad."""
    found = OnAllRows((1e-3, 1e-3, 1e-3), (zero,))
    requested = Judgement((0, 1), True, 0.0, (), {}, (), undecided=(1,))
    _, decided = all_rows._significant(
        found, requested, each_by_itself(lambda selection, _: selection)
    )
    assert decided.accused == stays


def test_terms_that_came_to_zero_are_removed_together():
    """Each would cost a refit of all rows; the others' values do not depend on them."""
    found = OnAllRows((1e-3, 1e-3, 1e-3), (0.0,))
    size = 5e-3  # Nm, a tenth of its deviation
    frictions = [Term("coulomb_friction", Site(j), (0.0,)) for j in (1, 2, 3)]
    found.terms = (Term("coulomb_friction", Site(4), (size,)), *frictions)
    found.covariance = [np.eye(1) * (10 * size) ** 2] * 4
    found.term_index, found.prior = (0, 1, 2, 3), {}
    own = [SimpleNamespace(effect=effect_named(t.effect)) for t in found.terms]
    found.space = SimpleNamespace(candidates=own)
    refitted_with = []

    def alone(selection, accused):
        refitted_with.append(tuple(accused))
        return selection

    requested = Judgement((0, 1, 2, 3), True, 0.0, (), {}, ())
    _, decided = all_rows._significant(found, requested, each_by_itself(alone))
    assert refitted_with == [(0,), ()]
    assert decided.withdrawn == tuple((p, NOT_SIGNIFICANT) for p in (1, 2, 3, 0))


def test_a_gain_that_is_not_significant_is_removed_before_what_it_scales():
    """A torque constant of 0.94 +- 1.3 halved a UR10e's friction, and made it as unsure."""
    terms = [Term("coulomb_friction", Site(6), (1.5,)), Term("torque_constant", Site(6), (0.9,))]
    refitted_with = []

    def selection_of(spread):
        found = OnAllRows((0.0, 0.0, 0.0), (0.0,))
        found.terms, found.term_index, found.prior = tuple(terms), (0, 1), {}
        found.covariance = [np.eye(1) * spread] * 2
        own = [SimpleNamespace(effect=effect_named(t.effect)) for t in terms]
        found.space = SimpleNamespace(candidates=own)
        return found

    def alone(selection, accused):
        refitted_with.append(tuple(accused))
        return selection_of(1e-3)

    zero = SimpleNamespace(alone=lambda kept: ([np.zeros(1)] * len(kept), [np.eye(1)] * len(kept)))
    refits = SimpleNamespace(alone=alone, linearised=lambda *_: zero)
    requested = Judgement((0, 1), True, 0.0, (), {}, ())
    _, decided = all_rows._significant(selection_of(1.0), requested, refits)
    assert refitted_with == [(0,)]
    assert decided.accused == (0,)
    assert decided.withdrawn == ((1, NOT_SIGNIFICANT),)


def test_what_a_removal_makes_insignificant_is_removed_before_the_next_refit():
    """Followed to first order, one refit in place of one for each term; the refit decides."""
    terms = [Term("coulomb_friction", Site(j), (1.0,)) for j in (1, 2, 3, 4)]
    refitted_with = []

    def selection_of(sizes):
        found = OnAllRows((0.0, 0.0, 0.0), (0.0,))
        found.terms = tuple(t.with_values([v]) for t, v in zip(terms, sizes, strict=True))
        found.covariance, found.term_index = [np.eye(1) * 1e-2] * 4, (0, 1, 2, 3)
        found.prior = {}
        own = [SimpleNamespace(effect=effect_named(t.effect)) for t in terms]
        found.space = SimpleNamespace(candidates=own)
        return found

    def alone(selection, accused):
        refitted_with.append(tuple(accused))
        return selection_of([1.0, 0.0, 0.0, 0.1] if len(refitted_with) == 1 else [1.0] * 4)

    def to_first_order(kept):  # without joint 3 joint 2's is gone, and then joint 4's is sure
        sizes = {(0, 1, 3): [1.0, 0.1, 0.2], (0, 3): [1.0, 1.0], (0,): [1.0]}[tuple(kept)]
        return [np.array([v]) for v in sizes], [np.eye(1) * 1e-2] * len(kept)

    refits = SimpleNamespace(
        alone=alone, linearised=lambda *_: SimpleNamespace(alone=to_first_order)
    )
    requested = Judgement((0, 1, 2, 3), True, 0.0, (), {}, ())
    found = selection_of([1.0, 0.5, 0.1, 0.5])
    _, decided = all_rows._significant(found, requested, refits)
    assert refitted_with == [(0, 3), (0,)]
    assert [p for p, _ in decided.withdrawn] == [2, 1, 3]


def test_what_came_back_undecided_is_removed_before_what_it_replaces():
    """A UR10's joint 2: Stribeck friction of 300 rows, and its Coulomb friction was gone."""
    found = OnAllRows((0.0, 0.0, 0.0), (0.0,))
    found.terms = tuple(Term("coulomb_friction", Site(j), (v,)) for j, v in ((1, 0.0), (2, 0.5)))
    found.covariance, found.term_index, found.prior = [np.eye(1) * 1e-2] * 2, (0, 1), {}
    own = [SimpleNamespace(effect=effect_named(t.effect)) for t in found.terms]
    found.space = SimpleNamespace(candidates=own)
    without_the_other = SimpleNamespace(alone=lambda _: ([np.ones(1)], [np.eye(1) * 1e-2]))
    refits = SimpleNamespace(alone=lambda *_: found, linearised=lambda *_: without_the_other)
    least = {1: 4.0}  # the second one is undecided: 5 sigmas of six
    assert all_rows._insignificant(found, (0, 1), least, refits) == [1]
