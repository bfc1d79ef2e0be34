"""The downhill simplex goes as scipy's does, step by step."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from gapbridge.core.estimation.nelder_mead import nelder_mead


def valley(x: np.ndarray) -> float:
    return float(100 * (x[1] - x[0] ** 2) ** 2 + (1 - x[0]) ** 2 + np.sum(np.abs(x[2:] - 3)))


@pytest.mark.parametrize("start", [(-1.2, 1.0), (0.0, 0.0), (2.0, -1.0, 0.0)])
@pytest.mark.parametrize("most", [7, 120, 400])
def test_it_ends_where_scipys_ends(start, most):
    options = {"maxiter": most, "xatol": 0.02, "fatol": 0.05}
    expected = minimize(valley, start, method="Nelder-Mead", options=options)
    found, value = nelder_mead(valley, np.array(start), most, 0.02, 0.05)
    np.testing.assert_array_equal(found, expected.x)
    assert value == expected.fun
