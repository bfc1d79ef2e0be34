"""Ties: what fits as well in the place of a cause, alone and not only beside it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import toy_candidates as toy

from gapbridge.core.diagnosis.selection.sample_space import fit
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.diagnosis.ties import tied, ties_of
from gapbridge.core.effects import Site, Term

ROWS = 200


def selection_of(space, chosen=(0,), **observation):
    known = {"payload_mass": None, "axes": ("joint_1",), "channel": "torque"} | observation
    return SimpleNamespace(
        space=space, working=space, best=fit(space, chosen), excerpt=None, base=(), block=(),
        observation=SimpleNamespace(**known),
    )  # fmt: skip


def test_what_does_all_that_a_cause_does_and_more_is_a_tie():
    """A heavier link 1 of an upright arm is one whose centre of gravity is further out."""
    candidates = [toy.named("link_inertia", 1, 1), toy.named("link_cog", 3, 1),
                  toy.named("link_cog", 3, 2), toy.named("payload")]  # fmt: skip
    free = toy.random_space(5, candidates, rows=120, planted=(0,), size=30.0)
    X = free.X.copy()
    X[:, 1:4] = X[:, :1] * [0.3, -0.2, 0.5]
    upright = toy.space_of(candidates, free.y, X)
    assert ties_of(selection_of(upright), [0]) == {0: ("link_cog",)}
    assert ties_of(selection_of(free), [0]) == {0: ()}


def scaled_or(effect: str, rigid: float, in_blocks: bool):
    """Return a joint's selection: ``effect`` is in its torque, whose reading may be scaled.

    ``rigid`` is the torque that it holds at all times without the effect.
    """
    rng = np.random.default_rng(3)
    sign = np.sign(rng.normal(size=ROWS)) if effect == "coulomb_friction" else np.ones(ROWS)
    value = 2.0

    def predict(terms):
        torque = np.full(ROWS, rigid)
        torque = torque + sign * sum(t.values[0] for t in terms if t.effect == effect)
        scale = 1 + sum(t.values[0] for t in terms if t.effect == "torque_constant")
        return (torque * scale)[:, None]

    candidates = [toy.named(effect, 1, 1), toy.named("torque_constant", 1, 1)]
    X = np.column_stack([sign, rigid + value * sign])
    space = toy.space_of(candidates, value * sign + rng.normal(0, 1e-2, ROWS), X)
    found = selection_of(space, predict=predict, measured=predict([]))
    found.base = (Term(effect, Site(1), (value,)),)
    found.kept, found.links = np.ones(ROWS, dtype=bool), None
    found.noise = SimpleNamespace(whitener=np.ones((ROWS, 1, 1)))
    found.nuisance_basis = np.zeros((ROWS, 0))
    found.plain_rows_of = partial(Selection.plain_rows_of, found)
    found.rows_of = partial(Selection.rows_of, found)
    if not in_blocks:
        return found
    sums = selection_of(space, measured=np.zeros((2, 1)))
    sums.excerpt = found
    return sums


@pytest.mark.parametrize("in_blocks", [False, True])
def test_friction_of_a_joint_that_does_little_else_is_no_scaled_reading(in_blocks):
    """The torque whose reading would be scaled is the friction itself."""
    found = scaled_or("coulomb_friction", 1e-6, in_blocks)
    assert ties_of(found, [0]) == {0: ()}


@pytest.mark.parametrize("in_blocks", [False, True])
def test_an_offset_of_a_joint_whose_torque_never_changes_is_a_scaled_reading(in_blocks):
    found = scaled_or("torque_offset", 30.0, in_blocks)
    assert ties_of(found, [0]) == {0: ("torque_constant",)}


def test_what_fits_no_better_than_nothing_in_its_place_is_no_tie():
    """At rest a servo's droop was called a latency, which does nothing there."""
    space = toy.random_space(7, [toy.named("servo_droop", 1, 2), toy.named("latency", 1, 2)])
    X = space.X.copy()
    X[:, 1] = 0.0
    assert ties_of(selection_of(toy.space_of(space.candidates, space.y, X)), [0]) == {0: ()}


@pytest.mark.parametrize(
    ("mass", "joints", "tie"),
    [(None, 2, True), (np.full(90, 2.0), 2, True), (np.arange(90.0), 2, False), (None, 3, False)],
)
def test_under_one_load_its_centre_is_the_last_links_first_moment(mass, joints, tie):
    """In motion they differ by a rotational inertia that nobody knows."""
    candidates = [toy.named("payload_cog", 3), toy.named("link_cog", 3, 1),
                  toy.named("link_cog", 3, 2)]  # fmt: skip

    def tied_alone(c: int) -> list[int]:
        space = toy.random_space(9, candidates, planted=(c,), size=30.0)
        return tied(selection_of(space, (c,), payload_mass=mass, axes=("joint",) * joints), c)

    assert [tied_alone(c) for c in range(3)] == ([[2], [], [0]] if tie else [[], [], []])


def test_so_it_is_where_all_links_are_a_cause_together():
    """Their centres were named one by one, and that of the last link as no tie."""
    candidates = [toy.named("payload_cog", 3), *(toy.named("link_cog", 3, j) for j in (1, 2))]
    found = selection_of(toy.random_space(9, candidates), (), axes=("joint",) * 2)
    found.block = (1, 2)
    assert ties_of(found, [1, 2]) == {1: (), 2: ("payload_cog",)}


def test_without_a_load_there_is_no_centre_of_it():
    needy = replace(toy.named("payload_cog", 3), requires="payload")
    candidates = [toy.named("link_cog", 3, 1), needy, toy.named("payload")]
    space = toy.random_space(9, candidates, planted=(0, 2), size=30.0)
    assert ties_of(selection_of(space), [0]) == {0: ()}
    assert ties_of(selection_of(space, (0, 2)), [0]) == {0: ("payload_cog",)}
