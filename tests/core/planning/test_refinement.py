"""Poses moved so that no place of the workspace is known much worse than the others."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from planned_cell import LOADS, POSITION, SIGMA, small_model, small_parameters, small_space

from gapbridge.core.planning.candidates import candidates_of
from gapbridge.core.planning.design import reference_of
from gapbridge.core.planning.information import Reference, blocks, information_of, inverse
from gapbridge.core.planning.refinement import ROUNDS, Refined, Refiner, evened, leaning

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def begun() -> tuple[Refiner, Reference, Refined]:
    """Return 14 poses as they fell."""
    model = small_model()
    parameters, space = small_parameters(model), small_space(model)
    loads = sorted(LOADS, key=lambda load: load.mass)
    found = candidates_of(parameters, POSITION, loads, space, 5, 150)
    rows = blocks(parameters, POSITION, found.readings, found.nuisance, SIGMA)
    reference = reference_of(parameters, loads, space, 5)
    some = np.random.default_rng(2).choice(len(rows), 14, replace=False)
    weight = reference.weight(rows.shape[2])
    refiner = Refiner(parameters, POSITION, space, found, weight, SIGMA)
    return refiner, reference, Refined(found.readings[some], rows[some])


def std(reference: Reference, rows: Array) -> Array:
    return reference.std(inverse(information_of(rows)))


def test_places_known_worse_weigh_more(begun: tuple[Refiner, Reference, Refined]) -> None:
    _, reference, poses = begun
    share, known = leaning(reference, poses.rows), std(reference, poses.rows)
    assert share.mean() == pytest.approx(1.0)
    assert (np.argsort(share) == np.argsort(known)).all()
    again = leaning(reference, poses.rows, share)
    assert again.mean() == pytest.approx(1.0)
    assert again == pytest.approx(share**2 / np.mean(share**2))


def test_the_worst_place_gets_better_and_the_mean_hardly_pays_for_it(
    begun: tuple[Refiner, Reference, Refined],
) -> None:
    refiner, reference, poses = begun
    reported: list[float] = []
    found, weight = evened(
        refiner, reference, poses, leaning(reference, poses.rows), 0, reported.append
    )
    by_mean = refiner.refined(poses, ROUNDS, np.random.default_rng(0))
    even, usual = std(reference, found.rows), std(reference, by_mean.rows)
    assert even.max() < 0.97 * usual.max()
    assert np.sqrt(np.mean(even**2)) < 1.05 * np.sqrt(np.mean(usual**2))
    assert reported == sorted(reported) and reported[-1] == 1.0
    # the weight that comes with them is the one that they were judged by last
    last = Refiner(refiner.parameters, POSITION, refiner.workspace, refiner.found, weight, SIGMA)
    assert last.value(found.rows) <= last.value(by_mean.rows)
