"""Poses moved so that no place of the workspace is known much worse than the others."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from planned_cell import LOADS, POSITION, SIGMA, small_model, small_parameters, small_space

from gapbridge.core.planning.candidates import sample_candidates
from gapbridge.core.planning.design import draw_reference
from gapbridge.core.planning.information import Reference, information_of, inverse, whitened_rows
from gapbridge.core.planning.refinement import (
    ROUNDS,
    RefinedPoses,
    Refiner,
    minimax_refined,
    reference_weights,
)

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def begun() -> tuple[Refiner, Reference, RefinedPoses]:
    """Return 14 poses as they fell."""
    model = small_model()
    parameters, space = small_parameters(model), small_space(model)
    loads = sorted(LOADS, key=lambda load: load.mass)
    found = sample_candidates(parameters, POSITION, loads, space, 5, 150)
    rows = whitened_rows(parameters, POSITION, found.readings, found.nuisance, SIGMA)
    reference = draw_reference(parameters, loads, space, 5)
    some = np.random.default_rng(2).choice(len(rows), 14, replace=False)
    weight = reference.weight(rows.shape[2])
    refiner = Refiner(parameters, POSITION, space, found, weight, SIGMA)
    return refiner, reference, RefinedPoses(found.readings[some], rows[some])


def std(reference: Reference, rows: Array) -> Array:
    return reference.std(inverse(information_of(rows)))


def test_places_known_worse_weigh_more(begun: tuple[Refiner, Reference, RefinedPoses]) -> None:
    _, reference, poses = begun
    share, known = reference_weights(reference, poses.rows), std(reference, poses.rows)
    assert share.mean() == pytest.approx(1.0)
    assert (np.argsort(share) == np.argsort(known)).all()
    again = reference_weights(reference, poses.rows, share)
    assert again.mean() == pytest.approx(1.0)
    assert again == pytest.approx(share**2 / np.mean(share**2))


def test_the_worst_place_gets_better_and_the_mean_hardly_pays_for_it(
    begun: tuple[Refiner, Reference, RefinedPoses],
) -> None:
    refiner, reference, poses = begun
    reported: list[float] = []
    found, weight = minimax_refined(
        refiner, reference, poses, reference_weights(reference, poses.rows), 0, reported.append
    )
    by_mean = refiner.refined(poses, ROUNDS, np.random.default_rng(0))
    even, usual = std(reference, found.rows), std(reference, by_mean.rows)
    assert even.max() < 0.97 * usual.max()
    assert np.sqrt(np.mean(even**2)) < 1.05 * np.sqrt(np.mean(usual**2))
    assert reported == sorted(reported) and reported[-1] == 1.0
    # the weight that comes with them is the one that they were judged by last
    last = Refiner(
        refiner.parameters, POSITION, refiner.workspace, refiner.candidates, weight, SIGMA
    )
    assert last.value(found.rows) <= last.value(by_mean.rows)
