"""A refit goes on downhill where one of its parameters has come to its bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.selection.candidate import named_candidates
from gapbridge.core.diagnosis.selection.refit import _step

ARM = builtin_arm("ur5")


@pytest.fixture
def flexible():
    """Two candidates of one parameter each, 0 or more."""
    found = [c for c in named_candidates(ARM, "position", (), False, (), [1.0] * 6)
             if c.family == "radial_compliance" and len(c.parameters) == 1]  # fmt: skip
    return [replace(c, parameters=(replace(c.parameters[0], lower=0.0),)) for c in found[:2]]


def test_a_parameter_on_its_bound_is_fixed_and_the_others_are_solved(flexible):
    rng = np.random.default_rng(1)
    A = rng.normal(size=(40, 3))
    A[:, 0] += 0.9 * A[:, 1]
    b = A @ np.array([-1.0, 2.0, 0.5])
    x = [np.zeros(1), np.ones(1)]
    step = _step(A, b, np.ones(3), flexible, x)
    alone = np.linalg.lstsq(A[:, 1:], b, rcond=None)[0]
    assert step[0] == 0.0
    assert step[1:] == pytest.approx(alone)
    free = _step(A, b, np.ones(3), flexible, [np.ones(1), np.ones(1)])
    assert free == pytest.approx([-1.0, 2.0, 0.5])
