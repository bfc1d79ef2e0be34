"""The table of faults: every row, by family."""

from __future__ import annotations

from benchmarks.faults.families import (
    answers,
    connection,
    daemon,
    loop,
    robot,
    sections,
    silence,
    ur_library,
    values,
    writing,
)
from benchmarks.faults.row import Row

FAMILIES = (
    silence,
    connection,
    values,
    answers,
    ur_library,
    robot,
    writing,
    sections,
    loop,
    daemon,
)
ROWS: tuple[Row, ...] = tuple(row for family in FAMILIES for row in family.ROWS)
"""All rows, in the order of docs/reliability.md."""


def rows_of(link: str, shared: bool = True) -> list[Row]:
    """Return the rows of a link: those made on a running rig, or those with one of their own."""
    return [row for row in ROWS if link in row.links and row.shares == shared]
