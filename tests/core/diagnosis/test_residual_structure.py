"""Residual structure: noise has none, structure is seen, and what it follows is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toy_candidates as toy
from hypothesis import given, settings
from hypothesis import strategies as st

from gapbridge.core.diagnosis import residual_structure
from gapbridge.core.diagnosis.residual_structure import dependence, structure_p_value
from gapbridge.core.estimation.least_squares import basis_of

ROWS = 90
CANDIDATES = [
    *(toy.named("joint_offset", 1, j) for j in range(1, 4)),
    *(toy.smooth(f"actual_q_{j}", f"joint_{j + 1}", 4) for j in range(3)),
    toy.smooth("timestamp", size=4), toy.smooth("joint_temperatures_0", size=2),
    toy.smooth("joint_temperatures_1", size=2),
]  # fmt: skip
TIME = 6
FRAME = np.linalg.qr(np.random.default_rng(9).normal(size=(ROWS, 6)))[0]
GROUPS = np.repeat(np.arange(ROWS // 3), 3)


def space(seed: int, planted=(), size: float = 1.0):
    return toy.random_space(seed, CANDIDATES, ROWS, planted, size)


def test_noise_has_no_structure_as_often_as_the_probability_says():
    wide = np.linalg.qr(np.random.default_rng(8).normal(size=(ROWS, 35)))[0]
    drawn = np.array([structure_p_value(space(s), wide, ()) for s in range(60)])
    for level in (0.05, 0.2, 0.5, 0.8):
        spread = np.sqrt(level * (1 - level) / len(drawn))
        assert abs(np.mean(drawn < level) - level) < 4 * spread


@pytest.mark.parametrize("planted", [3, TIME])
def test_what_a_family_can_make_is_structure_until_it_is_in_the_model(planted):
    structured = space(1, (planted,))
    assert structure_p_value(structured, FRAME, ()) < 0.002
    assert structure_p_value(structured, FRAME, (planted,)) > 0.01


@settings(max_examples=5, deadline=None)
@given(share=st.floats(1e-6, 1e6))
def test_the_unit_of_the_gap_does_not_matter(share):
    one = space(2, (0,), 0.4)
    other = replace(one, y=one.y * share)
    assert structure_p_value(other, FRAME, ()) == structure_p_value(one, FRAME, ())


def test_what_a_frame_absorbs_is_no_structure():
    clean = space(3)
    tilted = replace(clean, y=clean.y + FRAME @ np.full(6, 50.0))
    assert structure_p_value(tilted, FRAME, ()) == pytest.approx(
        structure_p_value(clean, FRAME, ())
    )


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 999), planted=st.sampled_from([3, 4, 5, TIME]))
def test_what_the_residual_depends_on_comes_first(seed, planted):
    reported = dependence(space(seed, (planted,)), FRAME, (), GROUPS)
    name, share = reported[0]
    assert name == CANDIDATES[planted].quantity
    assert 0.4 < share < 1
    shares = [s for _, s in reported]
    assert shares == sorted(shares, reverse=True)
    assert len({n for n, _ in reported}) == len(reported)


def test_noise_follows_nothing():
    shares = [dependence(space(s), FRAME, (), GROUPS)[0][1] for s in range(20)]
    assert np.median(shares) < 0.05


def test_what_is_in_the_model_is_not_followed_any_more():
    both = space(5, (3, TIME))
    reported = dict(dependence(both, FRAME, (3,), GROUPS))
    assert max(reported, key=lambda n: reported[n]) == "timestamp"
    assert reported["actual_q_0"] < 0.1


def test_a_function_is_judged_on_conditions_that_it_was_not_fitted_to():
    """Each pose has its own level: within a pose it can be foretold, of another pose it cannot."""
    levels = np.repeat(np.random.default_rng(0).normal(size=ROWS // 3) * 5, 3)
    one = toy.space_of(
        [toy.smooth("actual_q_0", size=30)], levels, np.kron(np.eye(30), np.ones((3, 1)))
    )
    together = dict(dependence(one, np.zeros((ROWS, 0)), (), GROUPS))
    apart = dict(dependence(one, np.zeros((ROWS, 0)), (), np.arange(ROWS)))
    assert together["actual_q_0"] < 0.05
    assert apart["actual_q_0"] > 0.9


@pytest.mark.parametrize("target", ["joint_1", "position"])
@pytest.mark.parametrize(("first", "jumped"), [(0, False), (20, True), (45, True), (75, True)])
def test_what_was_there_all_the_time_does_not_depend_on_it(target, first, jumped):
    """A jump near the beginning is nearly a constant."""
    rng = np.random.default_rng(4)
    way, angle, row = rng.normal(size=ROWS), rng.normal(size=ROWS), np.arange(ROWS)
    starts = np.linspace(5, 85, 17)
    candidates = [
        toy.smooth("actual_q_0", "joint_1", 2), toy.smooth("timestamp", target),
        *(replace(toy.smooth("timestamp", target), jumps=True) for _ in starts),
    ]  # fmt: skip
    X = np.column_stack([
        way, way * angle, way * (row - row.mean()) / row.std(),
        *(way * (row > start) for start in starts),
    ])  # fmt: skip
    y = 5 * way * (row >= first) + rng.normal(size=ROWS)
    shares = dict(dependence(toy.space_of(candidates, y, X), np.zeros((ROWS, 0)), (), GROUPS))
    assert (shares["timestamp"] > 0.6) == jumped
    assert jumped or shares["timestamp"] < 0.05


def test_joint_temperatures_rise_together_and_are_reported_once():
    names = [n for n, _ in dependence(space(6, (7,)), FRAME, (), GROUPS)]
    assert sum(n.startswith("joint_temperatures_") for n in names) == 1
    assert names[0] == "joint_temperatures_0"


def test_a_basis_is_orthonormal_and_spans_what_it_was_made_of():
    columns = np.random.default_rng(1).normal(size=(20, 3))
    twice = np.hstack([columns, columns @ np.ones((3, 1))])
    basis = basis_of(twice)
    assert basis.shape == (20, 3)
    assert np.allclose(basis.T @ basis, np.eye(3))
    assert np.allclose(basis @ (basis.T @ twice), twice)


@pytest.mark.parametrize("columns", [20, 400])
def test_squares_along_few_and_many_columns_are_those_of_their_products(columns):
    rng = np.random.default_rng(columns)
    X, residuals = rng.normal(size=(30, columns)), rng.normal(size=(500, 30))
    used, sizes = rng.permutation(columns)[: columns - 7], rng.uniform(1, 2, columns - 7)
    found = residual_structure._squares_along(X, used, sizes, residuals)
    expected = np.sum((residuals @ (X[:, used] / sizes)) ** 2, axis=1)
    assert found == pytest.approx(expected, rel=1e-12)


def test_without_a_direction_left_there_is_no_structure():
    whole = np.linalg.qr(np.random.default_rng(7).normal(size=(ROWS, ROWS - 1)))[0]
    bare = space(0)
    inside = replace(bare, X=whole @ (whole.T @ bare.X))
    assert structure_p_value(inside, whole, ()) == 1.0
