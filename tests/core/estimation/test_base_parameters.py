"""What data show of flexibilities alone, together, or not at all; the rest is held and named."""

import numpy as np
import pytest

from gapbridge.core.effects import flexibility_names
from gapbridge.core.estimation.base_parameters import (
    VISIBLE,
    choose_identifiable,
    identifiability_of,
    residual_noise,
)
from gapbridge.core.estimation.compliance_fit import ProjectedSystem
from gapbridge.core.notes import Note, Reason

SIGMA = 1e-4  # rad/Nm, the prior's


def problem(columns, values):
    """Return a problem whose columns (M, 4) are given in units of the noise per prior sigma."""
    columns = np.asarray(columns, dtype=float)
    return ProjectedSystem(columns / SIGMA, columns / SIGMA @ (np.asarray(values) * SIGMA))


def chosen(linear):
    kept = choose_identifiable(linear, (np.zeros(4), SIGMA))
    return kept, identifiability_of(linear, kept, SIGMA)


def test_what_has_columns_of_its_own_is_kept_and_the_empty_ones_are_held():
    kept, shown = chosen(problem(np.diag([50.0, 20.0, 0.0, 1.0]), [1, 1, 0, 0]))
    assert kept.tolist() == [True, True, False, False]
    held = [Note(Reason.HELD, (f"radial_compliance_{i}",)) for i in (1, 2)]
    assert list(shown.notes) == held
    std = np.sqrt(np.diag(shown.covariance)) / SIGMA
    np.testing.assert_allclose(std[:2], [1 / 50, 1 / 20], rtol=2e-3)
    np.testing.assert_array_equal(std[2:], 1)


def test_the_noise_of_a_residual_is_per_degree_of_freedom():
    rng, every, variance = np.random.default_rng(0), np.ones(4, dtype=bool), []
    for _ in range(300):
        A, values = rng.normal(size=(7, 4)) * 50, np.full(4, 1.0)
        b = A @ values + rng.normal(0, 3.0, 7)
        linear = ProjectedSystem(A / SIGMA, b)
        best = np.linalg.lstsq(A, b, rcond=None)[0] * SIGMA
        variance.append(residual_noise(linear, best, every, SIGMA, 7.0) ** 2)
    assert np.mean(variance) == pytest.approx(9.0, rel=0.1)
    shown, wide = (identifiability_of(linear, every, SIGMA, noise) for noise in (1.0, 3.0))
    np.testing.assert_allclose(np.diag(wide.covariance), 9 * np.diag(shown.covariance), rtol=0.01)


def test_two_that_act_alike_are_carried_by_one_and_both_are_named():
    columns = np.diag([50.0, 40.0, 30.0, 0.0])
    columns[:, 3] = columns[:, 1]
    kept, shown = chosen(problem(columns, [1, 0.5, 1, 0.5]))
    assert kept[[0, 2]].all()
    assert kept[1] != kept[3]
    (note,) = shown.notes
    assert note.reason is Reason.ACTS_LIKE
    ((share, carrier),) = note.values[1]
    assert share == pytest.approx(1.0)
    assert {note.values[0], carrier} == set(flexibility_names(2)[1::2])


def test_of_a_difference_the_one_is_kept_that_can_carry_it_without_going_below_zero():
    columns = np.diag([50.0, 40.0, 30.0, 0.0])
    columns[:, 3] = -columns[:, 1]
    for values, carrier in (([1, 0.7, 1, 0.1], 1), ([1, 0.1, 1, 0.7], 3)):
        assert chosen(problem(columns, values))[0].tolist() == [
            True, carrier == 1, True, carrier == 3
        ]  # fmt: skip


def test_a_sum_that_shows_though_none_of_its_members_does_is_named():
    # four columns alike, each just too short to be shown alone
    columns = np.zeros((4, 4))
    columns[0] = 0.7 * VISIBLE
    kept, shown = chosen(problem(columns, [1, 1, 1, 1]))
    assert not kept.any()
    together = [note for note in shown.notes if note.reason is Reason.SHOWN_TOGETHER]
    assert len(together) == 1
    assert {part for _, part in together[0].values[0]} == set(flexibility_names(2))
    np.testing.assert_allclose([share for share, _ in together[0].values[0]], 0.5)


@pytest.mark.parametrize("sign", [1, -1])
def test_two_kept_ones_whose_sum_is_much_better_known_are_named(sign):
    columns = np.diag([50.0, 0.0, 0.0, 50.0])
    columns[0, 1], columns[1, 1], columns[2, 2] = sign * 500, 5, 50
    columns[0, 0] = 500
    _, shown = chosen(problem(columns, [1, 1, 1, 1]))
    assert shown.notes[0].reason is (Reason.SUM_KNOWN if sign > 0 else Reason.DIFFERENCE_KNOWN)
    assert shown.notes[0].values[:2] == ("axial_compliance_1", "axial_compliance_2")


def test_flexibilities_are_named_as_the_effects_are():
    assert [flexibility_names(7)[i] for i in (0, 6, 7, 13)] == [
        "axial_compliance_1", "axial_compliance_7", "radial_compliance_1", "radial_compliance_7"
    ]  # fmt: skip
