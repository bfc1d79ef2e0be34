"""The columns of a log: their names, how many belong together, and which one a misspelt one means.

Names are RTDE's.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence

import numpy as np

from gapbridge.core.arrays import Array

PARQUET = (".parquet", ".pq")  # endings of a name
# name -> number of columns: 0 = one column without index, None = one per joint
COLUMNS: dict[str, int | None] = {
    "timestamp": 0,
    "session": 0,
    "target_q": None,
    "actual_q": None,
    "actual_qd": None,
    "actual_current_as_torque": None,
    "joint_temperatures": None,
    "payload": 0,
    "payload_cog": 3,
    "actual_TCP_force": 6,
    "ft_raw_wrench": 6,
    "approach": None,
    "measured_position": 3,
    "measured_rotation": 3,
    "actual_TCP_pose": 6,  # of a simulator: what the controller takes its TCP for, no measurement
}
INDEXED = re.compile(r"(.+)_(\d{1,9})$")
ALIKE = 0.85  # likeness of two names from which one may be the other misspelt
# RTDE fields with names similar to a log's columns: not treated as misspelt
OTHERS = {
    "target_qd", "target_qdd", "target_moment", "target_current", "target_TCP_pose",
    "target_TCP_speed", "actual_current", "actual_current_window",
    "actual_TCP_speed", "payload_mass", "payload_inertia", "joint_mode", "joint_control_output",
}  # fmt: skip


def is_known(name: str) -> bool:
    """Return whether a log may hold a column, index included."""
    match = INDEXED.match(name)
    return COLUMNS.get(name) == 0 or bool(match and COLUMNS.get(match[1], 0) != 0)


def wanted_of(names: Sequence[str]) -> list[int]:
    """Return the positions of the columns that a log may hold."""
    return [i for i, name in enumerate(names) if is_known(name)]


def indices(name: str, n: int) -> list[str]:
    """Return the suffixes of ``name`` in the columns of an arm of n joints: '_0', ... or ''."""
    count = COLUMNS[name]
    return [""] if count == 0 else [f"_{i}" for i in range(n if count is None else count)]


def scalars(columns: Mapping[str, Array | None]) -> dict[str, Array]:
    """Return each scalar (N,) of columns (N,) or (N, k) by its name in a log; None is left out."""
    result: dict[str, Array] = {}
    for name, values in columns.items():
        if values is None:
            continue
        if values.ndim == 1:
            result[name] = values
        else:
            result |= {f"{name}_{i}": values[:, i] for i in range(values.shape[1])}
    return result


def as_table(columns: Mapping[str, Array | None]) -> tuple[list[str], Array]:
    """Return the names (k) and values (N, k) of the scalars of columns (N,) or (N, m)."""
    named = scalars(columns)
    return list(named), np.column_stack(list(named.values()))


def written(name: str, n: int) -> str:
    """Return a column group as messages write it: ``actual_q_0..5``, ``payload``."""
    ends = indices(name, n)
    return f"{name}_0..{len(ends) - 1}" if ends[0] else name


def label(column: str) -> str:
    """Return a column as people read it: joints from 1 and its name, ``joint 2 (actual_q_1)``."""
    match = INDEXED.match(column)
    if match and COLUMNS.get(match[1], 0) is None:
        return f"joint {int(match[2]) + 1} ({column})"
    return column


def misspelt(unknown: Sequence[str], names: Sequence[str], n: int) -> tuple[str, str] | None:
    """Return which of the ``unknown`` columns may mean which of ``names``, or None."""
    likeness = [
        (difflib.SequenceMatcher(None, found.lower(), meant.lower()).ratio(), found, meant)
        for found in unknown
        if re.sub(r"_\d+$", "", found) not in OTHERS
        for meant in (f"{name}{index}" for name in names for index in indices(name, n))
    ]
    ratio, found, meant = max(likeness, key=lambda one: one[0], default=(0.0, "", ""))
    return (found, meant) if ratio >= ALIKE else None


def did_you_mean(unknown: Sequence[str], names: Sequence[str], n: int) -> str:
    """Return the end of a message on missing ``names``: what may be misspelt, or ''."""
    pair = misspelt(unknown, names, n)
    return f"; found {pair[0]}; did you mean {pair[1]}?" if pair else ""


def nearest(names: Sequence[str]) -> str:
    """Return the hint for a file without known columns: the nearest name, or those expected."""
    for name in names:
        stem = re.sub(r"_\d+$", "", name)
        near = difflib.get_close_matches(stem.lower(), COLUMNS, n=1, cutoff=0.6)
        if near:
            end = "" if COLUMNS[near[0]] == 0 else name[len(stem) :] or "_0"
            return f"; found {name!r}, did you mean {near[0] + end!r}?"
    more = ", ..." if len(names) > 6 else ""
    return f" ({', '.join(names[:6])}{more}), expected RTDE field names"
