"""What the search explains by an unnamed function is structure, whatever a global test says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small

from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.metrology import Metrology


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
