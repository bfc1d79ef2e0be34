"""The robust fit: what least squares says without outliers, and the same beside them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from further import further
from scipy.stats import t as student

from gapbridge.core.estimation.registration import Registration, register
from gapbridge.core.estimation.robust import (
    distance_of,
    robust_fit,
    scale_of,
    start_weights,
    weights_of,
)

ROWS, WIDTH, NUMBERS = 30, 3, 5


def drawn(
    seed: int, rows: int = ROWS, numbers: int = NUMBERS
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return equations of ``rows`` readings of three cells, true values, and each cell's row."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(rows * WIDTH, numbers))
    truth = rng.normal(size=numbers)
    b = A @ truth + rng.normal(0.0, 1e-3, rows * WIDTH)
    return A, b, truth, np.repeat(np.arange(rows), WIDTH)


def one_unit(b: np.ndarray) -> np.ndarray:
    return np.zeros(len(b), dtype=np.int64)


def test_without_outliers_it_is_about_least_squares() -> None:
    for seed in range(10):
        A, b, _, row = drawn(seed)
        found = robust_fit(A, b, one_unit(b), row)
        plain = np.linalg.lstsq(A, b, rcond=None)[0]
        deviation = np.sqrt(np.diag(found.covariance))
        assert np.all(np.abs(found.values - plain) < 1.0 * deviation)
        assert len(found.outliers) <= 1


@pytest.mark.parametrize(("rows", "numbers"), [(12, 6), (12, 18), *further((5, 6), (40, 60))])
def test_the_stated_deviations_are_those_of_the_errors(rows: int, numbers: int) -> None:
    """Also where a third to a half of the cells is spent, as in a session of a few touches."""
    scaled, noise = [], []
    for seed in range(150):
        A, b, truth, row = drawn(seed, rows=rows, numbers=numbers)
        found = robust_fit(A, b, one_unit(b), row)
        scaled.append((found.values - truth) / np.sqrt(np.diag(found.covariance)))
        noise.append(found.noise[0])
    assert np.median(noise) == pytest.approx(1e-3, rel=0.15)
    free = rows * WIDTH - numbers
    spread = np.quantile(np.abs(scaled), 0.68) / student.ppf(0.84, free)
    assert spread == pytest.approx(1.0, rel=0.15)


def test_wide_readings_count_as_wholly_as_narrow_ones() -> None:
    """A reading's distance is the mean of its cells: a dozen are no outlier by their sum."""
    for cells in (1, 12):
        rng = np.random.default_rng(cells)
        A = rng.normal(size=(40 * cells, NUMBERS))
        b = A @ rng.normal(size=NUMBERS) + rng.normal(0.0, 1e-3, len(A))
        found = robust_fit(A, b, one_unit(b), np.repeat(np.arange(40), cells))
        assert np.mean(found.weights) > 0.95


@pytest.mark.parametrize("share", [0.1, 0.3])
@pytest.mark.parametrize("seed", range(5))
def test_outliers_are_found_as_wholes_and_change_nothing(seed: int, share: float) -> None:
    A, b, _, row = drawn(seed)
    bad = np.random.default_rng(seed).choice(ROWS, int(share * ROWS), replace=False)
    good = ~np.isin(row, bad)
    alone = np.linalg.lstsq(A[good], b[good], rcond=None)[0]
    for k in bad:  # all to one side: a fit of least squares follows them
        b[row == k] += 0.05 * (1.0 + A[row == k, 0])
    found = robust_fit(A, b, one_unit(b), row)
    assert set(bad) <= set(found.outliers.tolist())
    assert np.abs(found.values - alone).max() < 5e-4
    assert np.abs(np.linalg.lstsq(A, b, rcond=None)[0] - alone).max() > 2e-3


@pytest.mark.parametrize("seed", range(5))
def test_a_third_of_gross_outliers_to_one_side_are_seen(seed: int) -> None:
    A, b, truth, row = drawn(seed, numbers=2)
    bad = np.random.default_rng(seed).choice(ROWS, ROWS // 3, replace=False)
    A[:, 0] = 1.0
    b = A @ truth + np.random.default_rng(seed + 50).normal(0.0, 1e-3, len(b))
    b[np.isin(row, bad)] += 0.02
    found = robust_fit(A, b, one_unit(b), row)
    assert set(bad) == set(found.outliers.tolist())
    assert np.abs(found.values - truth).max() < 1e-3


def test_cells_of_two_units_have_each_their_own_noise() -> None:
    rng = np.random.default_rng(3)
    A, b, truth, row = drawn(3, rows=200)
    unit = (np.arange(len(b)) % WIDTH == 2).astype(np.int64)
    b[unit == 1] += rng.normal(0.0, 0.02, int(unit.sum()))
    found = robust_fit(A, b, unit, row)
    np.testing.assert_allclose(found.noise, [1e-3, 0.02], rtol=0.15)
    assert np.abs(found.values - truth).max() < 3e-4


@pytest.mark.parametrize("seed", range(3))
def test_a_third_of_points_off_alike_needs_the_weight_to_begin_with(seed: int) -> None:
    """Why there are two weights: the one that falls to zero does not come away from a bad start."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.7, 0.7, (70, 3))
    seen = points + rng.normal(0.0, 5e-5, points.shape)
    seen[rng.choice(70, 23, replace=False)] += [1e-2, 3e-3, -2e-3]

    def off(weights: Callable[[np.ndarray], np.ndarray], frame: Registration) -> Registration:
        for _ in range(20):
            frame = register(seen, points, weights(frame.in_base(seen) - points))
        return frame

    def biweight(gap: np.ndarray) -> np.ndarray:
        return weights_of(distance_of(gap, scale_of(gap)))

    begun = off(start_weights, register(seen, points))
    errors = [
        np.linalg.norm(frame.in_base(points) - points, axis=1).mean()
        for frame in (off(biweight, register(seen, points)), begun, off(biweight, begun))
    ]
    assert errors[0] > 3e-3
    assert errors[1] < 1e-4
    assert errors[2] < 3e-5
