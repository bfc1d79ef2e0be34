"""A run beyond what its model was fitted on is warned of, once for as long as it lasts."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.daemon.fitted_watch import QUIET, FittedWatch
from gapbridge.bridge.ipc.shared_memory import slices_of

SLICES = slices_of(6)
WIDTH = max(part.stop for part in SLICES.values())
FITTED = {"actual_q_1": (-1.0, 1.0), "payload": (0.0, 5.0)}


def cycles(joint_2: float, payload: float = 2.0, count: int = 3) -> np.ndarray:
    rows = np.zeros((count, WIDTH))
    rows[:, SLICES["actual_q"].start + 1] = joint_2
    rows[:, SLICES["payload"]] = payload
    return rows


def test_within_what_was_fitted_nothing_is_said() -> None:
    watch = FittedWatch(FITTED, SLICES)
    assert watch.take(cycles(0.9), 1.0) == []
    assert watch.take(cycles(1.05), 2.0) == []  # a twentieth of the range beyond it is none
    assert watch.take(cycles(np.nan, np.nan), 3.0) == []
    assert watch.take(np.empty((0, WIDTH)), 4.0) == []


def test_a_joint_outside_is_named_once_for_as_long_as_it_lasts() -> None:
    watch = FittedWatch(FITTED, SLICES)
    (line,) = watch.take(cycles(1.5), 1.0)
    assert line.startswith("joint 2 (actual_q_1): found 1.5 rad, outside what was fitted, -1 to 1")
    assert watch.take(cycles(1.6), 2.0) == []
    assert watch.take(cycles(0.0), 3.0) == []  # a moment within is no end of it
    assert watch.take(cycles(1.5), 4.0) == []
    assert watch.take(cycles(0.0), 4.0 + 2 * QUIET) == []
    assert len(watch.take(cycles(1.5), 5.0 + 2 * QUIET)) == 1


def test_a_load_outside_is_named_beside_a_joint() -> None:
    lines = FittedWatch(FITTED, SLICES).take(cycles(-2.0, 9.0), 1.0)
    assert [line.split(":")[0] for line in lines] == ["joint 2 (actual_q_1)", "payload"]


def test_a_cell_without_provenance_is_warned_of_nothing() -> None:
    assert FittedWatch({}, SLICES).take(cycles(99.0, 99.0), 1.0) == []
