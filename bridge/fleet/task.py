"""A task: the job on one session, run in any process; and its outcome."""

from __future__ import annotations

import functools
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.bridge.cell.opened_log import open_log
from gapbridge.bridge.document.output_file import printable
from gapbridge.bridge.fleet.session import natural_key
from gapbridge.core.errors import ArmError, CellError, GapbridgeError, LogError
from gapbridge.core.log.log import Log

SessionJob = Callable[[Cell, Log, Mapping[str, Any]], dict[str, Any]]
Stamp = tuple[str, int, int]  # path, bytes, ns: another one, another content
DONE, BAD, CRASHED, DIED = "done", "bad", "crashed", "died"
MAX_DEATHS = 2  # workers that a session may kill in one run


@dataclass(frozen=True)
class Task:
    """The job on one session, as it is sent to a worker."""

    key: str  # hash of log, cell, job and options: identifies reusable results
    arm: str
    session: str
    log: Path
    cell: Path
    job: SessionJob
    options: Mapping[str, Any] = field(default_factory=dict)
    cell_stamps: tuple[Stamp, ...] = ()  # of the cell and of the files that it names

    def outcome(self, state: str, seconds: float = 0.0, **rest: Any) -> Outcome:
        """Return an outcome of this task; ``rest`` are further fields of it.

        Its names are those of UTF-8, with the bytes of a path that are not escaped.
        """
        arm, session, log, cell = map(printable, (self.arm, self.session, self.log, self.cell))
        return Outcome(self.key, arm, session, log, cell, state, seconds, **rest)

    def died_outcome(self) -> Outcome:
        """Return the outcome of a task that has killed MAX_DEATHS workers."""
        text = f"{MAX_DEATHS} workers died over this session; it is not tried again in this run"
        return self.outcome(DIED, error=f"{self.log}: {text}")


@dataclass(frozen=True)
class Outcome:
    """The outcome of a task; ``result`` holds plain JSON values."""

    key: str
    arm: str
    session: str
    log: str
    cell: str
    state: str  # done, bad (input), crashed (unexpected error), died (killed its workers)
    seconds: float  # s by the worker's clock, reading the log included
    processor: float = 0.0  # s of CPU time
    error: str = ""  # one line
    details: str = ""  # the traceback of a crash
    result: Mapping[str, Any] = field(default_factory=dict)

    @property
    def final(self) -> bool:
        """Return whether a repetition would give the same outcome."""
        return self.state in (DONE, BAD)

    def document(self) -> dict[str, Any]:
        """Return it as JSON values; ``result`` is not copied."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def run_task(task: Task) -> Outcome:
    """Run a task; every failure except the death of the process becomes an outcome."""
    begin, spent = time.perf_counter(), time.process_time()
    state, rest = _result(task)
    seconds, processor = time.perf_counter() - begin, time.process_time() - spent
    return task.outcome(state, seconds, processor=processor, **rest)


def _result(task: Task) -> tuple[str, dict[str, Any]]:
    """Return the state and the fields of the outcome that belong to it."""
    try:
        cell = _cell(task.cell, task.cell_stamps, task.cell.stat().st_mtime_ns) if (
            task.cell.is_file()
        ) else load_cell(task.cell)  # fmt: skip
        return DONE, {"result": task.job(cell, open_log(task.log, cell), task.options)}
    except (ArmError, CellError, LogError) as error:  # their messages name the file
        return BAD, {"error": _line(error)}
    except GapbridgeError as error:
        return BAD, {"error": f"{task.log}: {_line(error)}"}
    except Exception as error:
        return CRASHED, {
            "error": f"{task.log}: {type(error).__name__}: {_line(error) or 'no message'}",
            "details": traceback.format_exc(),
        }


def _line(error: Exception) -> str:
    return " ".join(printable(error).split())


@functools.lru_cache(maxsize=64)
def _cell(path: Path, stamps: tuple[Stamp, ...], changed: int) -> Cell:
    """Return a cell, read once per process and state of its files: a cluster's workers stay."""
    return load_cell(path)


def usable(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the outcomes with a result."""
    return [o for o in outcomes if o.state == DONE]


def by_arm(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Return the usable sessions of each arm, sorted by date if all have one, else by name."""
    sessions_by_arm: dict[str, list[Outcome]] = {}
    for outcome in usable(outcomes):
        sessions_by_arm.setdefault(outcome.arm, []).append(outcome)
    for arm, sessions in sessions_by_arm.items():
        dated = all(o.result["time"] is not None for o in sessions)
        sessions_by_arm[arm] = sorted(
            sessions, key=lambda o: (o.result["time"] if dated else 0.0, natural_key(o.session))
        )
    return {arm: sessions_by_arm[arm] for arm in sorted(sessions_by_arm, key=natural_key)}
