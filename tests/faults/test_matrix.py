"""Every row of the table of faults, once on each link where it can happen."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from rigs import Rigs, quiet_link

from benchmarks.faults.injection import make_fault
from benchmarks.faults.links import LINKS
from benchmarks.faults.matrix import run_alone
from benchmarks.faults.row import Result, Row
from benchmarks.faults.table import ROWS, rows_of

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        os.environ.get("GAPBRIDGE_FAULT_MATRIX") != "1",
        reason="judges by milliseconds on a wire: a quiet machine and GAPBRIDGE_FAULT_MATRIX=1",
    ),
]
BUSY = 1.5  # processes that want to run, per core


def attempt(rigs: Rigs, name: str, row: Row) -> Result:
    """Make a fault, once. Skips where a machine that is too busy was late."""
    rig = rigs.of(name)
    before = rig.found.violated
    result = make_fault(rig, row)
    assert rig.found.violated == before, rig.found.violations[-3:]
    if result.wrong and os.getloadavg()[0] > BUSY * (os.cpu_count() or 1):
        pytest.skip(f"this machine is too busy to judge by time: {result.wrong[0][:200]}")
    return result


CASES = [(name, row) for name in LINKS for row in rows_of(name)]


@pytest.mark.parametrize(
    ("name", "row"), CASES, ids=[f"{name}-{row.key.replace(' ', '_')}" for name, row in CASES]
)
def test_a_fault_is_detected_and_answered_as_the_table_says(
    rigs: Rigs, name: str, row: Row
) -> None:
    assert attempt(rigs, name, row).wrong == ()


APART = [(name, row) for name in LINKS for row in rows_of(name, shared=False)]


@pytest.mark.parametrize(
    ("name", "row"), APART, ids=[f"{name}-{row.key.replace(' ', '_')}" for name, row in APART]
)
def test_a_fault_that_needs_a_daemon_of_its_own_is_answered_as_the_table_says(
    tmp_path: Path, name: str, row: Row
) -> None:
    assert run_alone(row, quiet_link(name), tmp_path).wrong == ()


def test_every_row_has_a_name_of_its_own_and_links_that_exist() -> None:
    keys = [row.key for row in ROWS]
    assert len(set(keys)) == len(keys)
    for row in ROWS:
        assert set(row.links) <= set(LINKS)
        assert (row.inject is None) != (row.apart is None)
