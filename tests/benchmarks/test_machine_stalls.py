"""What a machine takes from everybody is separated from what a program misses by itself."""

from __future__ import annotations

import time

import numpy as np
import pytest

from benchmarks.faults.soak import Quiet, missed_of
from benchmarks.machine_stalls import MachineStalls

CYCLE = 0.002


def stalls_at(*spans: tuple[float, float]) -> MachineStalls:
    stalls = MachineStalls()
    stalls.spans = list(spans)
    return stalls


def test_a_missed_cycle_belongs_to_the_stall_that_it_overlaps() -> None:
    slices = {"missed": slice(0, 1), "received": slice(1, 2)}
    quiet = Quiet()
    quiet.take(np.array([[0.0, 1.0], [1.0, 2.0], [2.0, 3.0]]), slices)
    assert quiet.missed == [(2.0, 1), (3.0, 2)]
    assert stalls_at((1.9955, 1.9985)).not_among(quiet.missed, CYCLE) == [(3.0, 2)]
    assert stalls_at((2.0001, 2.5)).not_among(quiet.missed, CYCLE) == quiet.missed
    assert stalls_at((0.0, 9.0)).not_among(quiet.missed, CYCLE) == []
    assert missed_of(quiet, stalls_at((1.9955, 1.9985)), CYCLE).startswith("50.000 % missed (33.33")


def test_without_real_time_priority_nothing_is_reported_of_the_machine() -> None:
    unknown = MachineStalls()
    assert not unknown.during(0.0, 1e9)
    assert missed_of(Quiet(cycles=3, missed=[(1.0, 1)]), unknown, CYCLE) == "25.000 % missed"


def test_watchers_end_with_the_block_and_show_stalls_within_it() -> None:
    begun = time.monotonic()
    with MachineStalls() as stalls:
        time.sleep(1.0)
    if stalls.spans is None:
        pytest.skip("real-time priority is not allowed here")
    assert all(begun < due < come < time.monotonic() for due, come in stalls.spans)
    assert all(watcher.returncode == 0 for watcher in stalls._watchers)
