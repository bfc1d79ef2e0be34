"""The space in which candidates compete: fits, gains, penalties and bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toy_candidates as toy
from hypothesis import given, settings
from hypothesis import strategies as st

from gapbridge.core.diagnosis.selection.forward_selection import forward_step, joining, projected
from gapbridge.core.diagnosis.selection.sample_space import fit, gains, penalties

FAMILIES = [toy.named("a", 1, 1), toy.named("a", 1, 2), toy.named("b", 3), toy.named("c", 2),
            toy.smooth("time", size=4)]  # fmt: skip
seeds = st.integers(0, 10_000)
sets = st.lists(st.integers(0, len(FAMILIES) - 1), unique=True, max_size=len(FAMILIES))
quick = settings(max_examples=25, deadline=None)


@quick
@given(seed=seeds, chosen=sets)
def test_a_fit_is_the_least_squares_solution(seed, chosen):
    space = toy.random_space(seed, FAMILIES, planted=(2,))
    found = fit(space, chosen)
    X = space.columns(chosen)
    expected = np.linalg.lstsq(X, space.y, rcond=None)[0] if chosen else np.zeros(0)
    residual = space.y - X @ expected
    assert found.rss == pytest.approx(float(residual @ residual))
    assert np.allclose(np.concatenate([*found.values, []]), expected)
    paid = space.penalty[list(chosen)].sum()
    assert found.score == pytest.approx(float(space.misfit(np.array(found.rss))) + paid)


@quick
@given(seed=seeds, chosen=sets, share=st.floats(1e-4, 1e4))
def test_neither_order_nor_units_of_parameters_change_a_score(seed, chosen, share):
    space = toy.random_space(seed, FAMILIES)
    found, turned = fit(space, chosen), fit(space, chosen[::-1])
    assert turned.score == pytest.approx(found.score)
    unit = np.where(np.arange(space.X.shape[1]) % 2, share, 1.0)
    unlimited = [replace(c, parameters=tuple(replace(p, scale=1e9) for p in c.parameters))
                 for c in FAMILIES]  # fmt: skip
    other = fit(replace(space, X=space.X * unit, candidates=tuple(unlimited)), chosen)
    assert other.score == pytest.approx(found.score)
    for c, mine, theirs in zip(chosen, found.values, other.values, strict=True):
        own = unit[space.start[c] : space.start[c + 1]]
        assert np.allclose(mine, theirs * own, atol=1e-9)


@quick
@given(seed=seeds, chosen=sets, new=st.integers(0, len(FAMILIES) - 1))
def test_one_more_term_never_fits_worse_and_always_pays(seed, chosen, new):
    if new in chosen:
        return
    space = toy.random_space(seed, FAMILIES)
    before, after = fit(space, chosen), fit(space, [*chosen, new])
    assert after.rss <= before.rss + 1e-9
    assert space.penalty[new] > 0
    assert space.misfit(np.array(after.rss)) <= space.misfit(np.array(before.rss)) + 1e-9


@quick
@given(seed=seeds, chosen=sets)
def test_growing_term_by_term_comes_to_the_joint_fit(seed, chosen):
    space = toy.random_space(seed, FAMILIES, planted=(0,))
    state = projected(space, ())
    for c in chosen:
        state = forward_step(space, state, c, 0.0)
    assert state.rss == pytest.approx(fit(space, chosen).rss)
    assert projected(space, chosen).rss == pytest.approx(state.rss)
    assert np.allclose(space.columns(chosen).T @ state.r, 0, atol=1e-8)


@quick
@given(seed=seeds, chosen=sets)
def test_a_gain_is_what_a_fit_would_take(seed, chosen):
    space = toy.random_space(seed, FAMILIES, planted=(1, 3))
    state = projected(space, chosen)
    gain, sign = gains(space, state.r, state.along)
    for c in set(range(len(FAMILIES))) - set(chosen):
        with_it = fit(space, [*chosen, c])
        assert gain[c] == pytest.approx(state.rss - with_it.rss, rel=1e-6, abs=1e-7)
        if len(FAMILIES[c].parameters) == 1:
            assert sign[c] == np.sign(with_it.values[-1][0])


@quick
@given(seed=seeds)
def test_children_come_best_first_with_the_score_of_the_joint_set(seed):
    space = toy.random_space(seed, FAMILIES, planted=(2,))
    reported = joining(space, (0,), 10)
    scores = [score for score, _ in reported]
    assert scores == sorted(scores)
    assert reported[0][1] == 2
    for score, c in reported:
        assert score == pytest.approx(fit(space, (0, c)).score)


def test_a_column_that_the_frame_took_up_gains_nothing():
    space = toy.random_space(0, FAMILIES)
    X = space.X.copy()
    X[:, 0] = 0.0
    gain, _ = gains(replace(space, X=X), space.y)
    assert gain[0] == 0
    assert np.all(gain[1:] > 0)


def test_a_candidate_never_named_twice_by_two_of_the_same_columns():
    space = toy.random_space(0, [toy.named("a", 1, 1), toy.named("b", 1, 1)])
    X = np.repeat(space.X[:, :1], 2, axis=1)
    twice = replace(space, X=X)
    assert fit(twice, (0, 1)).rss == pytest.approx(fit(twice, (0,)).rss)
    state = projected(twice, (0,))
    assert gains(twice, state.r, state.along)[0][1] == pytest.approx(0, abs=1e-9)


def test_what_cannot_be_negative_has_no_score_where_it_would_have_to():
    bounded = [toy.named("play", lower=0.0), toy.named("free")]
    space = toy.random_space(3, bounded, planted=(0,), size=-5.0)
    assert fit(space, (0,)).score == np.inf
    assert all(c != 0 for _, c in joining(space, (), 5))
    assert np.isfinite(fit(toy.random_space(3, bounded, planted=(0,), size=5.0), (0,)).score)


def test_an_absurd_size_is_no_explanation():
    space = toy.random_space(3, [toy.named("a")], planted=(0,), size=1e6)
    assert fit(space, (0,)).score == np.inf
    assert fit(toy.random_space(3, [toy.named("a")], planted=(0,), size=2.0), (0,)).score < np.inf


def test_more_parameters_more_alternatives_and_no_name_cost_more():
    alone = [toy.named("a", 1, 1), toy.named("b", 2), toy.smooth("time")]
    many = [*(toy.named("a", 1, j) for j in range(1, 8)), toy.named("b", 2), toy.smooth("time")]
    few, more = penalties(alone, 90.0), penalties(many, 90.0)
    assert more[0] > few[0]  # tried at seven joints
    assert more[-2] == few[1]
    assert few[1] > few[0]
    assert few[2] > few[0]
    assert np.all(penalties(alone, 900.0) > few)
    lines = [toy.named("transmission_error", 2, 1, order=o) for o in range(1, 60)]
    paid = penalties(lines, 90.0)
    assert paid[0] < paid[40]  # one turn is usual, forty are not
