"""Every row of the table of faults, once on each link where it can happen.

Judged by milliseconds on a wire: make everything runs this file after all others, alone.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from rigs import Rigs, judge, quiet_link

from benchmarks.faults.injection import make_fault
from benchmarks.faults.links import LINKS
from benchmarks.faults.matrix import run_alone
from benchmarks.faults.row import Row
from benchmarks.faults.table import ROWS, rows_of

pytestmark = pytest.mark.slow


CASES = [(name, row) for name in LINKS for row in rows_of(name)]


@pytest.mark.parametrize(
    ("name", "row"), CASES, ids=[f"{name}-{row.key.replace(' ', '_')}" for name, row in CASES]
)
def test_a_fault_is_detected_and_answered_as_the_table_says(
    rigs: Rigs, name: str, row: Row
) -> None:
    judge(make_fault(rigs.of(name), row))


APART = [(name, row) for name in LINKS for row in rows_of(name, shared=False)]


@pytest.mark.parametrize(
    ("name", "row"), APART, ids=[f"{name}-{row.key.replace(' ', '_')}" for name, row in APART]
)
def test_a_fault_that_needs_a_daemon_of_its_own_is_answered_as_the_table_says(
    tmp_path: Path, name: str, row: Row
) -> None:
    judge(run_alone(row, quiet_link(name), tmp_path))


def test_every_row_has_a_name_of_its_own_and_links_that_exist() -> None:
    keys = [row.key for row in ROWS]
    assert len(set(keys)) == len(keys)
    for row in ROWS:
        assert set(row.links) <= set(LINKS)
        assert (row.inject is None) != (row.apart is None)
