"""Linear least squares: with a prior, within bounds, and what a projection leaves."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear

from gapbridge.core.estimation.least_squares import (
    basis_of,
    bounded,
    inverse,
    inverse_lengths,
    projected_out,
    solve,
)


def test_a_term_that_the_other_regions_do_not_show_changes_nothing() -> None:
    """Its column is zero in the fitted rows: its value stays at zero, not anywhere."""
    rng = np.random.default_rng(0)
    A = np.column_stack([rng.normal(size=50), np.zeros(50), 1e-160 * rng.normal(size=50)])
    b = 3 * A[:, 0] + 0.01 * rng.normal(size=50)
    x = solve(A, b, np.array([1e-6, 1e-6, 1e-6]))
    assert abs(x[0] - 3) < 0.01
    assert np.abs(x[1:]).max() < 1e-6


def test_a_prior_is_a_reading_of_its_own() -> None:
    rng = np.random.default_rng(1)
    A, b, hold = rng.normal(size=(20, 4)), rng.normal(size=20), np.array([3.0, 0.0, 8.0, 1.0])
    expected = np.linalg.solve(A.T @ A + np.diag(hold**2), A.T @ b)
    np.testing.assert_allclose(solve(A, b, hold), expected, atol=1e-12)


def test_solution_and_covariance_are_those_of_any_unit() -> None:
    rng = np.random.default_rng(2)
    A, b, size = rng.normal(size=(30, 5)), rng.normal(size=30), 10.0 ** np.array([-8, -3, 0, 4, 7])
    np.testing.assert_allclose(solve(A * size, b) * size, solve(A, b), rtol=1e-9)
    wide = inverse((A * size).T @ (A * size)) * np.outer(size, size)
    np.testing.assert_allclose(wide, np.linalg.inv(A.T @ A), rtol=1e-9, atol=1e-12)


def test_bounded_solutions_are_those_of_scipys_search() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        size = int(rng.integers(1, 13))
        A = rng.normal(size=(25, size)) * 10.0 ** rng.integers(-3, 3, size)
        b, unit = rng.normal(size=25), inverse_lengths(A)
        lower = np.where(rng.random(size) < 0.3, -np.inf, -0.2 * rng.random(size) * unit)
        upper = np.where(rng.random(size) < 0.3, np.inf, 0.2 * rng.random(size) * unit)
        found, stuck = bounded(A, b, lower, upper)
        assert (found >= lower).all()
        assert (found <= upper).all()
        expected = lsq_linear(A * unit, b, (lower / unit, upper / unit), method="bvls").x
        np.testing.assert_allclose(found / unit, expected, atol=1e-8)
        np.testing.assert_array_equal(stuck, (found == lower) | (found == upper))


def test_what_is_projected_out_is_gone_and_what_depends_counts_once() -> None:
    rng = np.random.default_rng(3)
    columns = rng.normal(size=(30, 3))
    basis = basis_of(np.column_stack([columns, columns @ [1e5, -1.0, 2.0]]))
    assert basis.shape[1] == 3
    left = projected_out(basis, np.column_stack([columns, rng.normal(size=30)]))
    assert np.abs(left[:, :3]).max() < 1e-12
    assert np.abs(basis.T @ left).max() < 1e-12
