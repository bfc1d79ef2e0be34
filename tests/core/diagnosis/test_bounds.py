"""A refit goes on downhill where one of its parameters has come to its bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small

from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.channels import position, torque, wrench
from gapbridge.core.diagnosis.selection.candidate import named_candidates
from gapbridge.core.diagnosis.selection.refit import _step
from gapbridge.core.diagnosis.selection.rounds import payload_bounds
from gapbridge.core.metrology import Metrology

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


@pytest.mark.parametrize(
    ("declared", "cell", "bounds"),
    [
        (5.0, 0.0, (-5.0, 25.0)),  # the log's, also where it never changes
        (2.0, 8.0, (-2.0, 28.0)),
        (None, 8.0, (-8.0, 22.0)),
        ((2.0, 6.0), 0.0, (-2.0, 24.0)),  # no row's mass is negative
    ],
)
@pytest.mark.parametrize("channel", [position, torque, wrench])
def test_the_true_payload_is_from_nothing_to_three_times_the_rated(channel, declared, cell, bounds):
    session = small.session_of(0)
    rows = len(session.q)
    mass = None if declared is None else np.resize(declared, rows)
    log = small.log_of(
        session, np.zeros((rows, 3)) + session.q, payload=mass, payload_cog=None,
        actual_current_as_torque=np.random.default_rng(0).normal(size=(rows, 3)),
        ft_raw_wrench=np.random.default_rng(1).normal(size=(rows, 6)),
    )  # fmt: skip
    model = replace(small.model_of(), payload_mass=cell)  # rated for 10 kg
    seen = channel.observe(model, log, Metrology(registered=True))
    assert payload_bounds(model, seen) == pytest.approx(bounds)
