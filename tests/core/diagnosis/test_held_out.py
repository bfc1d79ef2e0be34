"""Held-out figures: no sample is judged by a fit that saw its pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small

from gapbridge.core.diagnosis.held_out import FOLDS, HeldOut

JOLT = 3.0  # whitened


@pytest.fixture(scope="module")
def selection():
    return small.diagnosed("backlash").channels[0].selection


def with_target(selection, target: np.ndarray):
    return replace(selection, unprojected=replace(selection.unprojected, target=target))


def jolted(selection, sample: int, size: float = JOLT):
    """Return the selection with one kept sample's reading moved."""
    target = selection.unprojected.target.copy()
    target[3 * sample : 3 * sample + 3] += size
    return with_target(selection, target)


def paired(selection):
    """Return the selection whose poses stand for each other two by two, as if repeated."""
    groups = np.arange(len(selection.observation.rows)) // 2
    return replace(selection, observation=replace(selection.observation, groups=groups))


def left_of(selection, chosen) -> np.ndarray:
    """Return the whitened held-out residual (N, 3) of each sample."""
    return HeldOut(selection)._residuals(tuple(sorted(chosen))).reshape(-1, 3)


def test_a_sample_never_helps_to_predict_itself(selection):
    """Moving one reading moves its own held-out residual by just as much, and others' by less."""
    chosen = selection.best.chosen
    before = left_of(selection, chosen)
    for sample in range(0, len(before), 7):
        after = left_of(jolted(selection, sample), chosen)
        assert np.allclose(after[sample] - before[sample], JOLT, atol=1e-8)
        others = np.delete(after - before, sample, axis=0)
        assert 0 < np.abs(others).max() < JOLT / 2


def test_repeats_of_a_pose_leave_together(selection):
    twins, chosen = paired(selection), selection.best.chosen
    before = left_of(twins, chosen)
    for sample in range(0, len(before) - 1, 6):
        mate = sample + 1 if sample % 2 == 0 else sample - 1
        after = left_of(jolted(twins, sample), chosen)
        assert np.allclose(after[mate], before[mate], atol=1e-9)


def test_each_sample_is_held_out_with_a_tenth_of_the_others(selection):
    before = left_of(selection, ())
    alike = [
        int(np.sum(np.abs(left_of(jolted(selection, s), selection.best.chosen)
                          - left_of(selection, selection.best.chosen)).max(axis=1) < 1e-9))
        for s in range(0, len(before), 9)
    ]  # fmt: skip
    # besides itself, those of its own fold do not feel it
    assert np.allclose(alike, len(before) / FOLDS - 1, atol=1.01)


def test_held_out_figures_are_those_of_a_cross_validation_by_hand(selection):
    chosen = selection.best.chosen
    held = HeldOut(selection)
    assert held.possible
    # noise-free exact linear data: nothing is left, whatever pose was out
    space = selection.space
    block = selection.unprojected.columns(space, chosen[:1])
    exact = with_target(selection, block @ np.ones(block.shape[1]))
    assert HeldOut(exact).rms(chosen) < 1e-9 * HeldOut(exact).rms(())
    assert held.rms(chosen) == pytest.approx(np.sqrt(np.mean(held.squares(chosen))))
    assert held.rms(chosen) == pytest.approx(small.FLOOR, rel=0.2)


def test_an_unnecessary_cause_does_not_reduce_the_held_out_gap(selection):
    space, chosen = selection.space, selection.best.chosen
    needless = next(c for c, k in enumerate(space.candidates) if k.family == "link_geometry")
    held = HeldOut(selection)
    more = held.shrink((*chosen, needless), chosen)
    assert more.shrink < 0.02
    assert more.interval[0] < 0
    fitted = held.shrink(chosen, ())
    assert fitted.shrink > 0.7
    assert fitted.interval[0] > 0.6


def test_a_shrink_is_one_less_the_ratio_of_its_gaps_and_repeats(selection):
    chosen = selection.best.chosen
    reported, again = (HeldOut(selection).shrink(chosen, ()) for _ in range(2))
    assert reported == again
    assert reported.shrink == pytest.approx(1 - reported.gap_with / reported.gap_without)
    assert reported.interval[0] <= reported.shrink <= reported.interval[1]
    nothing = HeldOut(selection).shrink(chosen, chosen)
    assert (nothing.shrink, nothing.interval) == (0.0, (0.0, 0.0))
    other = HeldOut(selection, seed=9).shrink(chosen, ())
    assert other != reported
    assert other.shrink == pytest.approx(reported.shrink, abs=0.05)


@pytest.mark.parametrize("twins", [False, True])
def test_the_interval_of_a_shrink_is_a_bootstrap_over_poses(selection, twins):
    """95 % over draws of whole conditions, done here the slow way."""
    held = HeldOut(paired(selection) if twins else selection)
    chosen = selection.best.chosen
    after, before = held.squares(chosen), held.squares(())
    count = 1 + twins
    rng, drawn = np.random.default_rng(5), []
    for _ in range(4000):
        groups = rng.integers(0, len(after) // count, len(after) // count)
        rows = (count * groups[:, None] + np.arange(count)).ravel()
        drawn.append(1 - np.sqrt(after[rows].sum() / before[rows].sum()))
    low, high = held.shrink(chosen, ()).interval
    expected = np.quantile(drawn, [0.025, 0.975])
    assert (low, high) == pytest.approx(tuple(expected), abs=0.15 * float(np.ptp(expected)))


def test_the_reported_figure_is_the_held_out_one():
    (channel,) = small.diagnosed("backlash").channels
    chosen = channel.selection.best.chosen
    held = HeldOut(channel.selection)
    assert channel.remaining_rms_held_out == held.rms(chosen)
    assert channel.causes[0].shrink.gap_with == held.rms(chosen)
    assert channel.held_out == pytest.approx(np.sqrt(held.squares(chosen)))


def test_two_conditions_are_needed(selection):
    one = replace(
        selection,
        observation=replace(
            selection.observation, groups=np.zeros(len(selection.kept), dtype=np.int64)
        ),
    )
    assert not HeldOut(one).possible


def test_a_parameter_without_effect_does_not_change_the_others(selection):
    """Of a link kept near nominal that the samples do not show only its prior is there."""
    chosen = list(selection.best.chosen)
    dead = next(c for c in range(len(selection.space.candidates)) if c not in chosen)
    own = selection.space.column_indices([dead])
    X, coefficients = selection.space.X.copy(), selection.unprojected.coefficients.copy()
    X[:, own] = coefficients[:, own] = 0.0
    blind = replace(
        selection, space=replace(selection.space, X=X),
        unprojected=replace(selection.unprojected, coefficients=coefficients),
        prior={dead: np.full(len(own), 1e-3)},
    )  # fmt: skip
    held = HeldOut(blind)
    assert held.rms([*chosen, dead]) == pytest.approx(held.rms(chosen), rel=1e-6)
