"""Text recordings under other column names: libfranka's CSV, the file of UR's RTDE recorder."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LogError
from gapbridge.core.log.columns import COLUMNS, is_known
from gapbridge.core.log.sources.source import Converted, Source, SourceOptions
from gapbridge.core.notes import Note, Reason

FRANKA = {  # libfranka's logToCSV -> the log's columns
    "state.q_d": "target_q", "state.q": "actual_q", "state.dq": "actual_qd",
    "state.tau_J": "actual_current_as_torque",
}  # fmt: skip
ELEMENT = re.compile(r"(.+?)(?:\[(\d+)\]|_(\d+))$")


class Libfranka(Source):
    """What ``franka::logToCSV`` writes: time in ms, vectors as ``state.q[0]``."""

    identifier = "libfranka"
    title = "libfranka's log as CSV"

    def holds(self, path: Path) -> bool:
        """Return whether the header is libfranka's."""
        return "state.q[0]" in _header(path, ",")

    def read(self, path: Path, arm_joints: Sequence[str], options: SourceOptions) -> Converted:
        """Return the log; see ``Source.read``."""
        columns = _vectors(path, ",", FRANKA)
        columns["timestamp"] = _column(path, ",", "time") * 1e-3
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
        columns = _vectors(path, None, {name: name for name in COLUMNS})
        for name in (name for name in _header(path, None) if COLUMNS.get(name) == 0):
            columns[name] = _column(path, None, name)
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


def _column(path: Path, delimiter: str | None, name: str) -> Array:
    return _numbers(path, delimiter, [_header(path, delimiter).index(name)])[:, 0]


def _vectors(path: Path, delimiter: str | None, wanted: dict[str, str]) -> dict[str, Array]:
    """Return the vectors (N, k) among the columns, under their new names."""
    places: dict[str, dict[int, int]] = {}
    for place, name in enumerate(_header(path, delimiter)):
        match = ELEMENT.fullmatch(name)
        if match and match[1] in wanted and (match[2] is not None or is_known(name)):
            places.setdefault(wanted[match[1]], {})[int(match[2] or match[3])] = place
    found = {}
    for name, by_index in places.items():
        if sorted(by_index) != list(range(len(by_index))):
            raise LogError(f"{path}: column {name}: found indices {sorted(by_index)}, expected "
                           f"0..{len(by_index) - 1}")  # fmt: skip
        found[name] = _numbers(path, delimiter, [by_index[i] for i in sorted(by_index)])
    return found


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
