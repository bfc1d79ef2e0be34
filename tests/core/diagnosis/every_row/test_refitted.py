"""All rows of a long log decide on what a search on some of them left open."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import small_arm as small

from gapbridge.core.diagnosis.every_row.refitted import (
    on_every_row,
    refitted,
    still_accused,
    with_uncertain_terms,
)
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.judgement import VAGUE, Judgement, judge

ALONE = partial(refitted, small.model_of(), False)


@pytest.fixture(scope="module")
def searched():
    selection = small.diagnosed("backlash").channels[0].selection
    return selection, judge(selection, HeldOut(selection))


def test_what_stays_beside_the_unknown_keeps_its_scatter_among_regions():
    """One accusation falls: the others' intervals were those of white noise from then on."""
    selection = small.diagnosed("cross_coupling").channels[0].selection
    everything = tuple(range(len(selection.terms)))
    white, _ = on_all(selection, Judgement(everything, True, 0.0, (), {}, ()))
    beside = refitted(small.model_of(), True, white, everything)
    for p in everything:
        assert beside.covariance[p].item() > 1.5 * white.covariance[p].item()


def on_all(selection, judgement):
    """Return the selection on all rows, and its held-out figures."""
    whole = on_every_row(selection, judgement, selection.observation, small.model_of())
    return whole, HeldOut(whole)


def withdrawn_as_vague(judgement, position):
    rest = tuple(p for p in judgement.accused if p != position)
    return replace(judgement, accused=rest, withdrawn=(*judgement.withdrawn, (position, VAGUE)))


def test_what_was_too_vague_on_some_rows_is_accused_where_all_rows_are_sure(searched):
    selection, judgement = searched
    position = judgement.accused[0]
    asked = with_uncertain_terms(withdrawn_as_vague(judgement, position))
    assert asked.vague == (position,)
    whole, held = on_all(selection, asked)
    _, decided = still_accused(whole, asked, held, ALONE)
    assert position in decided.accused
    assert position not in dict(decided.withdrawn)


def test_what_is_vague_on_all_rows_too_is_withdrawn(searched):
    selection, judgement = searched
    position = judgement.accused[0]
    asked = with_uncertain_terms(withdrawn_as_vague(judgement, position))
    whole, held = on_all(selection, asked)
    covariance = list(whole.covariance)
    value = np.array(whole.terms[position].values[: len(covariance[position])])
    covariance[position] = np.diag((value / 4.0) ** 2)  # enough for a word, not for an accusation
    unsure = replace(whole, covariance=tuple(covariance))
    _, decided = still_accused(unsure, asked, held, ALONE)
    assert position not in decided.accused
    assert dict(decided.withdrawn)[position] == VAGUE
    _, kept = still_accused(unsure, judgement, held, ALONE)
    assert position in kept.accused  # what some rows were sure of is not asked again
