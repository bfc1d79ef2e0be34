"""The samples that are searched represent all: every session, and what alternates."""

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


def test_one_row_is_drawn_of_each_stretch_and_the_same_again():
    rows = drawn(np.zeros(1000), 300)
    assert len(rows) == 300
    assert np.all(np.diff(rows) > 0)
    assert np.abs(rows - np.arange(300) * 10 / 3).max() < 4
    assert 0.4 < np.mean(rows % 2) < 0.6
    np.testing.assert_array_equal(rows, drawn(np.zeros(1000), 300))


@pytest.mark.parametrize(
    ("sizes", "counts"),
    [((3000, 4), (1196, 4)), ((5, 900, 2000, 40), (5, 577, 578, 40)), ((600, 600), (600, 600))],
)
def test_small_sessions_are_kept_whole(sizes, counts):
    session = np.repeat(np.arange(len(sizes)), sizes)
    taken = session[drawn(session, 1200)]
    assert tuple(np.bincount(taken)) == counts


@pytest.mark.parametrize("gain", [0.0, 0.1])
def test_two_loads_measured_in_turn_are_both_searched(gain):
    """At even distances only one of the loads would be: its weight and a gain look alike."""
    rows, rng = 600, np.random.default_rng(1)
    model = Model(builtin_arm("ur10e"))
    columns = {
        "timestamp": np.arange(rows) * 5.0, "actual_q": truth.poses(6, rows, 5),
        "payload": np.resize([5.0, 0.0], rows), "payload_cog": np.tile([0, 0, 0.06], (rows, 1)),
    }  # fmt: skip
    motion = with_pieces(model, motion_of(Log("turns.csv", columns, 6)))
    wrench = predict_wrench(model, motion, ()) * (1 + gain)
    columns["ft_raw_wrench"] = wrench + rng.normal(0, 1, (rows, 6)) * np.repeat([0.05, 0.002], 3)
    found = diagnose(model, Log("turns.csv", columns, 6))
    (channel,) = (c for c in found.channels if c.channel == "wrench")
    assert [c.effect for c in channel.causes] == (["ft_gain"] if gain else [])
    assert (channel.verdict == "no_gap") is not bool(gain)
