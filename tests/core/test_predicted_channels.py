"""Channels predicted piece by piece are those of the whole recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from gapbridge.core.arm import builtin_arm
from gapbridge.core.effects import Site, Term
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.predicted_channels import predicted_channels, with_neighbours

RATE, COUNT = 250.0, 6000
MODEL = Model(
    builtin_arm("ur10e"),
    terms=(Term("latency", Site(2), (0.02,)), Term("ft_drift", Site(), (0.1, 0, 0, 0, 0, 0))),
)


@pytest.fixture(scope="module")
def log() -> Log:
    t = 7.0 + np.arange(COUNT) / RATE
    t[3000:] += 2.0  # a pause
    q = np.array([0, -1.5, 1.5, -1.5, -1.5, 0]) + 0.3 * np.sin(t[:, None] + np.arange(6.0))
    return Log("log.csv", {"timestamp": t, "target_q": q, "actual_q": q}, 6)


def ragged(log: Log) -> Iterator[Log]:
    for begin in range(0, len(log), 700):
        yield log.select(slice(begin, min(begin + 700, len(log))))


def test_every_row_comes_once_with_its_line_and_predicted_as_in_the_whole(log: Log) -> None:
    whole, _ = predicted_channels(MODEL, log)
    lines, parts = [], []
    for around, own in with_neighbours(ragged(log), 900):
        found, needs = predicted_channels(MODEL, around)
        assert not needs
        lines += [around.line(row) for row in range(len(around))[own]]
        parts.append({name: values[own] for name, values in found.items()})
    assert lines == [log.line(row) for row in range(len(log))]
    assert len(parts) == 7
    for short, atol in (("torque", 0.02), ("wrench", 1e-3), ("q", 1e-12)):
        name = f"predicted_{short}"
        values = np.concatenate([part[name] for part in parts])
        np.testing.assert_array_equal(np.isnan(values), np.isnan(whole[name]))
        np.testing.assert_allclose(values, whole[name], rtol=0, atol=atol)


def test_a_short_log_comes_as_a_whole(log: Log) -> None:
    ((around, own),) = with_neighbours(ragged(log), COUNT)
    assert (len(around), own) == (COUNT, slice(0, COUNT))


def test_encoders_that_wrap_are_predicted_as_they_are_recorded(log: Log) -> None:
    whole, _ = predicted_channels(MODEL, log)
    q = log.columns["actual_q"] + [0, 0, 0, 0, 0, np.pi]
    wrapped = (q + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(np.diff(wrapped, axis=0)).max() > 6
    found, _ = predicted_channels(
        MODEL, replace(log, columns={**log.columns, "target_q": q, "actual_q": wrapped})
    )
    gap = whole["predicted_q"] - log.columns["actual_q"]
    np.testing.assert_allclose(found["predicted_q"] - wrapped, gap, atol=1e-9)
    good = np.isfinite(whole["predicted_torque"])
    np.testing.assert_array_equal(np.isfinite(found["predicted_torque"]), good)
