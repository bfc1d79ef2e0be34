"""The memory of a diagnosis: thousands of columns are kept once, and worked on a few at a time."""

from __future__ import annotations

import tracemalloc

import pytest

from benchmarks.blind.cases import make_case
from gapbridge.bridge.cell import load_cell
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.log.log import read_log

MOST = 85e6  # bytes beside the interpreter and its libraries; 71e6 were measured, of two searches


@pytest.fixture(scope="module")
def seventy_poses(tmp_path_factory):
    """Positions with rotations of a six-joint arm: the largest of the usual spaces."""
    folder = tmp_path_factory.mktemp("seventy")
    make_case("joint_offset", 77, folder)
    cell = load_cell(folder / "cell.yaml")
    return cell, read_log(folder / "log.csv", cell.arm.n)


@pytest.mark.slow
def test_seventy_poses_with_rotations_need_few_copies_of_their_columns(seventy_poses):
    cell, log = seventy_poses
    tracemalloc.start()
    try:
        found = diagnose(cell.model, log, cell.metrology)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    columns = found.channels[0].selection.space.X.nbytes
    assert columns > 15e6, "a smaller case would show nothing"
    assert peak < MOST
