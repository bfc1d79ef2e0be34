"""What all rows leave, beyond the noise of those that were searched, is never nothing."""

from __future__ import annotations

import moving_truth as truth
import numpy as np
import pytest

from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.thinning import drawn
from gapbridge.core.dynamics import predict_wrench, with_pieces
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import motion_of

ROWS = 600
NOISE = np.repeat([0.05, 0.002], 3)  # N, Nm


@pytest.mark.parametrize(("size", "found"), [(0.0, "no_gap"), (0.3, "unexplained")])
def test_a_cause_that_all_rows_withdraw_leaves_a_gap(size, found):
    """The searched rows have a bias, all others the opposite one."""
    model, searched = Model(builtin_arm("ur10e")), drawn(np.zeros(ROWS), 300)
    columns = {
        "timestamp": np.arange(ROWS) * 5.0, "actual_q": truth.poses(6, ROWS, 5),
        "payload": np.full(ROWS, 5.0), "payload_cog": np.tile([0, 0, 0.06], (ROWS, 1)),
    }  # fmt: skip
    motion = with_pieces(model, motion_of(Log("rest.csv", columns, 6)))
    wrench = predict_wrench(model, motion, ())
    wrench[:, 0] += size * np.where(np.isin(np.arange(ROWS), searched), 1, -1)
    wrench += np.random.default_rng(2).normal(0, 1, wrench.shape) * NOISE
    log = Log("rest.csv", columns | {"ft_raw_wrench": wrench}, 6)
    (channel,) = (c for c in diagnose(model, log).channels if c.channel == "wrench")
    assert not channel.causes
    assert channel.verdict == found
    assert channel.structured == bool(size)
    assert (channel.p_value < 1e-3) == bool(size)
