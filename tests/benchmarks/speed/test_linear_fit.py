"""The plain linear fit against scipy on stored rows."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.linalg import lstsq

from benchmarks.speed.linear_fit import fit_linear
from gapbridge.core.arm import builtin_arm
from gapbridge.core.effects import Site, Term
from gapbridge.core.errors import InputError
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model


def model_of() -> Model:
    tool = np.eye(4)
    tool[:3, 3] = (0.04, -0.03, 0.15)
    return Model(builtin_arm("ur10e"), tool, 4.0, np.array([0.0, 0.02, 0.1]))


def rows_of(count: int, spread: float = 2.5) -> tuple[np.ndarray, Loads, np.ndarray]:
    rng = np.random.default_rng(1)
    q = np.array([0.0, -1.2, 1.5, -1.8, -1.5, 0.3]) + rng.uniform(-spread, spread, (count, 6))
    loads = Loads(wrench=rng.normal(0, 30, (count, 6)))
    form = model_of().linear_form(q, loads).regressor[:, :3]
    gap = form @ rng.uniform(1e-6, 1e-5, 12) + rng.normal(0, 2e-5, (count, 3))
    return q, loads, gap


def test_the_fit_is_that_of_the_stored_rows():
    q, loads, gap = rows_of(1003)
    found = fit_linear(model_of(), q, loads, gap)
    stored = model_of().linear_form(q, loads).regressor[:, :3].reshape(-1, 12)
    expected = lstsq(stored, gap.ravel())[0]
    np.testing.assert_allclose(found.flexibility, expected, rtol=1e-9)
    assert found.rank == 12


def test_rows_that_hardly_differ_keep_their_digits():
    q, loads, gap = rows_of(800, spread=2e-4)
    assert loads.wrench is not None
    loads = Loads(wrench=1e-3 * loads.wrench)
    found = fit_linear(model_of(), q, loads, gap)
    stored = model_of().linear_form(q, loads).regressor[:, :3].reshape(-1, 12)
    unit = 1 / np.linalg.norm(stored, axis=0)
    expected = unit * lstsq(stored * unit, gap.ravel())[0]
    np.testing.assert_allclose(found.flexibility, expected, rtol=1e-6)


def test_what_no_row_shows_is_zero():
    q, _, gap = rows_of(300)
    found = fit_linear(model_of(), q, Loads(), gap)  # gravity never turns the first joint
    assert found.rank == 11
    assert found.flexibility[0] == 0.0


def test_memory_does_not_grow_with_the_rows():
    q, loads, gap = rows_of(60_000)
    fit_linear(model_of(), q[:100], loads[:100], gap[:100])
    tracemalloc.start()
    fit_linear(model_of(), q, loads, gap)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10e6


def test_links_that_bend_are_refused():
    q, loads, gap = rows_of(10)
    deflected = model_of().with_terms([Term("link_flexibility", Site(2), (1e-6,))])
    with pytest.raises(InputError, match="link that bends itself"):
        fit_linear(deflected, q, loads, gap)
