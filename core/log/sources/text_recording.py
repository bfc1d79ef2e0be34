"""Text recordings under other column names: libfranka's CSV, the file of UR's RTDE recorder."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LogError
from gapbridge.core.log.columns import INDEXED, wanted_of
from gapbridge.core.log.log import csv_table, table_columns, text_of
from gapbridge.core.log.sources.source import Converted, Source, SourceOptions
from gapbridge.core.notes import Note, Reason

FRANKA = {  # libfranka's logToCSV -> the log's columns
    "state.q_d": "target_q", "state.q": "actual_q", "state.dq": "actual_qd",
    "state.tau_J": "actual_current_as_torque",
}  # fmt: skip
ELEMENT = re.compile(r"(.+)\[(\d+)\]")


class Libfranka(Source):
    """What ``franka::logToCSV`` writes: time in ms, vectors as ``state.q[0]``."""

    identifier = "libfranka"
    title = "libfranka's log as CSV"

    def holds(self, path: Path) -> bool:
        """Return whether the header is libfranka's."""
        return "state.q[0]" in _names(_header(path), ",")

    def read(self, path: Path, arm_joints: Sequence[str], options: SourceOptions) -> Converted:
        """Return the log; see ``Source.read``."""
        names = [_log_name(name) for name in _names(_header(path), ",")]
        columns = _columns(path, ",", names, len(arm_joints))
        if "timestamp" not in columns:
            raise LogError(f"{path}: column time: not found, expected it (ms)")
        columns["timestamp"] *= 1e-3
        n = columns["actual_q"].shape[1]
        joints = tuple(f"joint{i + 1}" for i in range(n))
        return Converted(columns, joints, (Note(Reason.BEHIND_GEARS),))


class UrRecorder(Source):
    """What the RTDE client library's recorder writes: RTDE names, spaces (or tabs) in between."""

    identifier = "ur_recorder"
    title = "recording of UR's RTDE client (columns separated by spaces)"

    def holds(self, path: Path) -> bool:
        """Return whether the header is RTDE's, with spaces."""
        names, _ = _tabs_or_blanks(_header(path))
        between = any(mark in name for name in names for mark in ",;")  # a table, with blanks
        return len(names) > 1 and not between and ("actual_q_0" in names or "target_q_0" in names)

    def read(self, path: Path, arm_joints: Sequence[str], options: SourceOptions) -> Converted:
        """Return the log; see ``Source.read``."""
        names, delimiter = _tabs_or_blanks(_header(path))
        columns = _columns(path, delimiter, names, len(arm_joints))
        n = columns.get("actual_q", columns.get("target_q", np.empty((0, 0)))).shape[1]
        return Converted(columns, tuple(f"joint_{i + 1}" for i in range(n)))


def _header(path: Path) -> str:
    """Return the first line of a text file, '' where it is none."""
    if not path.is_file() or path.suffix.lower() not in (".csv", ".txt", ".log"):
        return ""
    try:
        with path.open(encoding="utf-8-sig") as file:
            return file.readline(65_536).rstrip("\n")
    except (OSError, UnicodeDecodeError):
        return ""


def _names(header: str, delimiter: str | None) -> list[str]:
    return [name.strip().strip('"') for name in header.split(delimiter)]


def _tabs_or_blanks(header: str) -> tuple[list[str], str | None]:
    """Return the names of a header, and what is between them: tabs, or else any blanks (None)."""
    delimiter = "\t" if "\t" in header.strip() else None
    return _names(header, delimiter), delimiter


def _log_name(name: str) -> str:
    """Return the log's name of a column of libfranka's, '' where it has none."""
    match = ELEMENT.fullmatch(name)
    if match and match[1] in FRANKA:
        return f"{FRANKA[match[1]]}_{match[2]}"
    return "timestamp" if name == "time" else ""


def _columns(path: Path, delimiter: str | None, names: Sequence[str], n: int) -> dict[str, Array]:
    """Return what of a file is a log's; ``names``: of all its columns, as a log has them.

    ``n``: joints, 0 where the file is to say it. Raises LogError as ``grouped`` and ``csv_table``
    do: a row with another number of cells than the header would be shifted.
    """
    known = [names[i] for i in wanted_of(names)]
    matches = [INDEXED.fullmatch(name) for name in known]
    joints = n or max(int(m[2]) + 1 for m in matches if m and m[1] in ("actual_q", "target_q"))
    return table_columns(path, known, _numbers(path, delimiter, names), joints)


def _numbers(path: Path, delimiter: str | None, names: Sequence[str]) -> Array:
    """Return the known columns (rows, known columns); an empty cell between tabs is NaN."""
    every = enumerate(text_of(path).split("\n")[1:], start=2)
    kept = [(number, line) for number, line in every if line.strip()]
    if not kept:
        raise LogError(f"{path}: found no rows below the header, expected rows of numbers")
    lines = [line for _, line in kept]
    if delimiter is None:
        lines = ["\t".join(line.split()) for line in lines]
    if delimiter != ",":  # a comma can only be the decimal point
        lines = [line.replace(",", ".") for line in lines]
    numbers = [number for number, _ in kept]
    return csv_table(path, names, numbers, lines, "," if delimiter == "," else "\t")
