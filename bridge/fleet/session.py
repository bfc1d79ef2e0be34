"""Finding the sessions of a fleet: its logs, and the arm of each."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gapbridge.bridge.document.provenance import digest
from gapbridge.core.errors import InputError
from gapbridge.core.log.columns import PARQUET

LOGS = (".csv", *PARQUET)
RESULTS_FILE, SESSIONS_FILE, CELL_TABLE = "results.parquet", "sessions.parquet", "cells.csv"
REPORT_FILE = "report.html"
WILDCARDS = re.compile(r"[*?\[]")


@dataclass(frozen=True)
class Session:
    """One log of one arm."""

    arm: str
    name: str  # unique: path below the folder of the fleet, without suffix
    log: Path


@dataclass(frozen=True)
class Fleet:
    """All sessions, sorted by name, and the rule by which arms were named."""

    folder: Path
    sessions: tuple[Session, ...]
    rule: str

    @property
    def arms(self) -> int:
        """Return the number of arms."""
        return len({s.arm for s in self.sessions})


def find_sessions(
    where: Sequence[str], pattern: str | None = None, without: Sequence[Path] = ()
) -> Fleet:
    """Return the sessions of folders, glob patterns and files.

    A log's arm is the first folder below the folder of the fleet; for a log in that folder itself,
    the file's name up to its first underscore. ``pattern`` is a regular expression that matches
    the arm in the path below the folder of the fleet instead (first group, or the whole match).
    The files ``without``, tables that a run reads or writes, are ignored, and so are those that
    an earlier run has written, and links to other logs of the fleet.
    Raises InputError if there is no log, or ``pattern`` does not match one.
    """
    found = {log for text in where for log in _logs(text)}
    own = {os.path.realpath(log) for log in found if not log.is_symlink()}
    tables = {os.path.realpath(table) for table in without}
    logs = sorted(
        (
            log
            for log in found
            if (place := os.path.realpath(log)) not in tables
            and not (log.is_symlink() and place in own)  # ``latest.csv`` would count twice
            and not _is_table(log)
        ),
        key=lambda p: natural_key(str(p)),
    )
    if not logs:
        raise InputError(f"{' '.join(where)}: found only tables of a run, expected logs")
    folder = _folder(where, logs)
    expression = _compiled(pattern)
    sessions = []
    for log in logs:
        below = Path(os.path.relpath(log, folder))
        name = below.with_suffix("").as_posix()
        sessions.append(Session(_arm(below, expression, pattern), name, log))
    _require_unique(sessions)
    rule = f"pattern {pattern!r}" if pattern else _rule(sessions)
    return Fleet(folder, tuple(sessions), rule)


def copies(sessions: Sequence[Session]) -> dict[Path, Path]:
    """Return the logs that hold the same bytes as an earlier one, with that one."""
    by_size: dict[int, list[Path]] = {}
    for session in sessions:
        if session.log.is_file():
            by_size.setdefault(session.log.stat().st_size, []).append(session.log)
    first: dict[str, Path] = {}
    copied = {}
    for log in (log for size, logs in by_size.items() if size and len(logs) > 1 for log in logs):
        content = digest(log)
        if content is not None and (other := first.setdefault(content, log)) != log:
            copied[log] = other
    return copied


def natural_key(text: str) -> list[tuple[int, int, str]]:
    """Return a key that sorts ``s2`` before ``s10``."""
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part)
        for part in re.split(r"(\d+)", text)
        if part
    ]


def _is_table(path: Path) -> bool:
    """Return whether a file has the name of a table that runs write, and its column ``arm``."""
    try:
        if path.name == CELL_TABLE:
            with path.open("rb") as file:
                return file.readline().strip() == b"arm,cell"
        if path.name in (RESULTS_FILE, SESSIONS_FILE):
            from pyarrow import parquet  # loaded where there is such a file

            return "arm" in parquet.read_schema(path).names
    except (OSError, ValueError):  # the reading of the log says what is wrong
        pass
    return False


def _logs(text: str) -> list[Path]:
    path = Path(text)
    if path.is_dir():
        if not os.access(path, os.R_OK | os.X_OK):
            raise InputError(f"{text}: this user may not read the folder, expected logs")
        found = [p for p in path.rglob("*") if p.suffix.lower() in LOGS and p.is_file()]
        if not found:
            raise InputError(f"{text}: found no log in this folder, expected CSV or Parquet files")
        return found
    if path.is_file():
        return [path]
    if WILDCARDS.search(text):
        found = [Path(p) for p in glob.glob(text, recursive=True)]
        found = [p for p in found if p.is_file() and p.suffix.lower() in LOGS]
        if not found:
            raise InputError(f"{text}: found no log that fits, expected CSV or Parquet files")
        return found
    raise InputError(f"{text}: not found, expected a folder of logs, a glob pattern or a log")


def _folder(where: Sequence[str], logs: Sequence[Path]) -> Path:
    if len(where) == 1 and Path(where[0]).is_dir():
        return Path(where[0])
    return Path(os.path.commonpath([log.absolute().parent for log in logs]))


def _compiled(pattern: str | None) -> re.Pattern[str] | None:
    try:
        return None if pattern is None else re.compile(pattern)
    except re.error as error:
        raise InputError(f"--arm: found {pattern!r}, no regular expression ({error})") from None


def _arm(below: Path, expression: re.Pattern[str] | None, pattern: str | None) -> str:
    if expression is None:
        return below.parts[0] if len(below.parts) > 1 else below.stem.split("_")[0]
    match = expression.search(below.as_posix())
    if match is None:
        raise InputError(f"--arm: {pattern!r} does not fit {below.as_posix()}")
    name = match.group(1) if expression.groups else match.group()
    if not name:
        raise InputError(f"--arm: {pattern!r} matches nothing of {below.as_posix()}")
    return name


def _require_unique(sessions: Sequence[Session]) -> None:
    seen: dict[str, Path] = {}
    for session in sessions:
        if session.name in seen:
            raise InputError(
                f"{session.log}: found beside {seen[session.name].name}, expected one log of a name"
            )
        seen[session.name] = session.log


def _rule(sessions: Sequence[Session]) -> str:
    flat = sum("/" not in s.name for s in sessions)
    if flat == 0:
        return "arm: name of the folder"
    if flat == len(sessions):
        return "arm: name of the file up to its first underscore"
    return "arm: name of the folder, or of the file up to its first underscore"
