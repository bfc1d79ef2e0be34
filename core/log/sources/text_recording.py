"""Text recordings under other column names: libfranka's CSV, the file of UR's RTDE recorder."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LogError
from gapbridge.core.log.columns import INDEXED, wanted_of
from gapbridge.core.log.log import table_columns
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
        return "state.q[0]" in _header(path, ",")

    def read(self, path: Path, arm_joints: Sequence[str], options: SourceOptions) -> Converted:
        """Return the log; see ``Source.read``."""
        names = [_log_name(name) for name in _header(path, ",")]
        columns = _columns(path, ",", names, len(arm_joints))
        if "timestamp" not in columns:
            raise LogError(f"{path}: column time: not found, expected it (ms)")
        columns["timestamp"] *= 1e-3
        n = columns["actual_q"].shape[1]
        joints = tuple(f"joint{i + 1}" for i in range(n))
        return Converted(columns, joints, (Note(Reason.BEHIND_GEARS),))


class UrRecorder(Source):
    """What the RTDE client library's recorder writes: RTDE names, spaces in between."""

    identifier = "ur_recorder"
    title = "recording of UR's RTDE client (columns separated by spaces)"

    def holds(self, path: Path) -> bool:
        """Return whether the header is RTDE's, with spaces."""
        names = _header(path, None)
        between = any(mark in name for name in names for mark in ",;")  # a table, with blanks
        return len(names) > 1 and not between and ("actual_q_0" in names or "target_q_0" in names)

    def read(self, path: Path, arm_joints: Sequence[str], options: SourceOptions) -> Converted:
        """Return the log; see ``Source.read``."""
        columns = _columns(path, None, _header(path, None), len(arm_joints))
        n = columns.get("actual_q", columns.get("target_q", np.empty((0, 0)))).shape[1]
        return Converted(columns, tuple(f"joint_{i + 1}" for i in range(n)))


def _header(path: Path, delimiter: str | None) -> list[str]:
    """Return the names in the first line of a text file, [] where it is none."""
    if not path.is_file() or path.suffix.lower() not in (".csv", ".txt", ".log"):
        return []
    try:
        with path.open(encoding="utf-8-sig") as file:
            return [name.strip().strip('"') for name in file.readline(65_536).split(delimiter)]
    except (OSError, UnicodeDecodeError):
        return []


def _log_name(name: str) -> str:
    """Return the log's name of a column of libfranka's, '' where it has none."""
    match = ELEMENT.fullmatch(name)
    if match and match[1] in FRANKA:
        return f"{FRANKA[match[1]]}_{match[2]}"
    return "timestamp" if name == "time" else ""


def _columns(path: Path, delimiter: str | None, names: Sequence[str], n: int) -> dict[str, Array]:
    """Return what of a file is a log's; ``names``: of all its columns, as a log has them.

    ``n``: joints, 0 where the file is to say it. Raises LogError as ``grouped`` does.
    """
    places = wanted_of(names)
    known = [names[i] for i in places]
    matches = [INDEXED.fullmatch(name) for name in known]
    joints = n or max(int(m[2]) + 1 for m in matches if m and m[1] in ("actual_q", "target_q"))
    return table_columns(path, known, _numbers(path, delimiter, places), joints)


def _numbers(path: Path, delimiter: str | None, places: list[int]) -> Array:
    try:
        return _loaded(path, delimiter, places, None)
    except (ValueError, OSError) as error:
        try:
            # between blanks a comma can only be the decimal point
            return _loaded(path, delimiter, places, None if delimiter else _comma_number)
        except (ValueError, OSError):
            raise LogError(f"{path}: found {error}, expected rows of numbers") from None


def _loaded(
    path: Path, delimiter: str | None, places: list[int], convert: Callable[[str], float] | None
) -> Array:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of no rows, which is an error here
        found = np.loadtxt(
            path, delimiter=delimiter, skiprows=1, usecols=places, ndmin=2, comments=None,
            encoding="utf-8-sig", converters=convert,
        )  # fmt: skip
    if not len(found):
        raise LogError(f"{path}: found no rows below the header, expected rows of numbers")
    return found


def _comma_number(text: str) -> float:
    return float(text.replace(",", "."))
