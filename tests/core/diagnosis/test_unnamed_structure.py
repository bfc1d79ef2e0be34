"""What the search explains by an unnamed function is structure, whatever a global test says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small
from further import further

from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.effects import Site, Term
from gapbridge.core.loads import Loads
from gapbridge.core.metrology import Metrology
from gapbridge.core.rotation import rotation_vector


@pytest.mark.parametrize("seed", [0, 1])
def test_an_unnamed_function_that_the_search_needs_is_structure(seed):
    """A drift of the instrument to and fro, beside play: what is explained is told apart."""
    session = small.session_of(seed, replace(small.PLAN, poses=40))
    read = small.readings(small.REAL["backlash"], session, seed)
    turn = 2.6 * np.pi * session.time / session.time.max()
    read += 2e-4 * np.outer(np.sin(turn), [1.0, 0.3, -0.5])
    found = diagnose(
        small.model_of(), small.log_of(session, read), Metrology(True, small.SIGMA)
    )  # fmt: skip
    (channel,) = found.channels
    assert {c.effect for c in channel.causes} <= {"backlash"}
    assert channel.structured
    assert channel.p_value < 1e-6
    assert channel.unexplained_rms > 2 * small.FLOOR


@pytest.mark.parametrize("seed", [0, *further(1)])
def test_a_tool_rotation_keeps_its_significance_with_a_function_of_the_last_joint(seed):
    """That function's constant is the same motion as a turn of the tool: the tool holds it."""
    session = small.session_of(seed, replace(small.PLAN, poses=40))
    model, rng = small.model_of(), np.random.default_rng(seed)
    q = session.q.copy()
    q[:, 2] += 4e-4 * np.exp(-(((q[:, 2] - 0.4) / 0.3) ** 2))
    bent = model.with_terms([Term("tool_frame", Site(), (1e-3, -2e-3, 5e-4, 0.0, 0.0, 0.0))])
    true = bent.predict(q, Loads())
    log = small.log_of(
        session, true.position + rng.normal(0, 1e-5, (40, 3)),
        measured_rotation=rotation_vector(true.rotation) + rng.normal(0, 3e-5, (40, 3)),
    )  # fmt: skip
    (channel,) = diagnose(model, log, Metrology(True, 1e-5)).channels
    (cause,) = (c for c in channel.causes if c.effect == "tool_frame")
    for p, value in zip(cause.parameters, (1e-3, -2e-3, 5e-4, 0, 0, 0), strict=True):
        assert p.value == pytest.approx(value, abs=3e-4)
        assert p.std < 2e-4
