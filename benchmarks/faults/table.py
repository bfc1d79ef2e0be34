"""The table of faults: every row, by family."""

from __future__ import annotations

from benchmarks.faults.families import (
    answers,
    connection,
    loop,
    robot,
    silence,
    ur_library,
    values,
    writing,
)
from benchmarks.faults.row import Row

FAMILIES = (silence, connection, values, answers, ur_library, robot, writing, loop)
ROWS: tuple[Row, ...] = tuple(row for family in FAMILIES for row in family.ROWS)
"""All rows, in the order of docs/reliability.md."""


def rows_of(link: str, apart: bool = False) -> list[Row]:
    """Return the rows of a link: those made on a running rig, or those apart."""
    return [row for row in ROWS if link in row.links and (row.apart is not None) == apart]
