"""Least squares without negative unknowns."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls

from gapbridge.core.estimation.nonnegative import nonnegative_least_squares


@given(st.integers(1, 14), st.integers(0, 20), st.integers(0, 2**31), st.floats(0, 6))
def test_it_is_scipys(unknowns, more, seed, decades):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(unknowns + more, unknowns)) @ np.diag(
        10 ** rng.uniform(-decades / 2, decades / 2, unknowns)
    )
    b = rng.normal(size=len(A))
    found, known = nonnegative_least_squares(A, b), nnls(A, b)[0]
    assert (found >= 0).all()
    size = np.linalg.norm(A, axis=0)
    np.testing.assert_allclose(found * size, known * size, atol=1e-9)
    assert np.linalg.norm(A @ found - b) == pytest.approx(np.linalg.norm(A @ known - b), abs=1e-12)


def test_what_nothing_asks_for_is_exactly_zero():
    A = np.vstack([np.eye(3), 0.1 * np.ones((1, 3))])
    found = nonnegative_least_squares(A, np.array([2.0, -1.0, 0.0, 0.0]))
    assert found[1] == found[2] == 0.0
    assert found[0] > 1.9


def test_columns_nearly_alike_end_too():
    A = np.ones((8, 4)) + 1e-13 * np.random.default_rng(3).normal(size=(8, 4))
    A = np.vstack([A, 1e-6 * np.eye(4)])
    found = nonnegative_least_squares(A, np.arange(12.0))
    assert (found >= 0).all() and np.isfinite(found).all()
