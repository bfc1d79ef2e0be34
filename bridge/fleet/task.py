"""A task: the work on one session, done in whatever process; and what comes of it."""

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
from gapbridge.bridge.fleet.session import natural
from gapbridge.core.errors import ArmError, CellError, GapbridgeError, LogError
from gapbridge.core.log.log import Log

Work = Callable[[Cell, Log, Mapping[str, Any]], dict[str, Any]]
DONE, BAD, CRASHED, DIED = "done", "bad", "crashed", "died"
DEATHS = 2  # a session that has taken so many workers along is not tried again


@dataclass(frozen=True)
class Task:
    """One session's work; it is sent to a worker as it stands."""

    key: str  # of log, cell, work and options: a result under this key is still good
    arm: str
    session: str
    log: Path
    cell: Path
    work: Work
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Outcome:
    """What came of a task; ``result`` holds plain JSON values."""

    key: str
    arm: str
    session: str
    log: str
    cell: str
    state: str  # done, bad (input), crashed (an error nobody foresaw), died (took workers along)
    seconds: float  # by the worker's clock, reading the log included
    processor: float = 0.0  # s of a processor: what it costs, however busy the machine is
    error: str = ""  # one line
    details: str = ""  # the traceback of a crash
    result: Mapping[str, Any] = field(default_factory=dict)

    @property
    def final(self) -> bool:
        """Return whether doing it again would come to the same."""
        return self.state in (DONE, BAD)

    def document(self) -> dict[str, Any]:
        """Return it as JSON values; ``result`` is the outcome's own, not a copy."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def outcome(task: Task, state: str, seconds: float = 0.0, **rest: Any) -> Outcome:
    """Return the outcome of a task."""
    return Outcome(
        task.key, task.arm, task.session, str(task.log), str(task.cell), state, seconds, **rest
    )


def died(task: Task) -> Outcome:
    """Return the outcome of a task that nobody lived through."""
    return outcome(
        task,
        DIED,
        error=f"{task.log}: {DEATHS} workers died over this session; it is not tried again "
        "in this run",
    )


def perform(task: Task) -> Outcome:
    """Do a task; whatever happens but the death of the process becomes an outcome."""
    begin, spent = time.perf_counter(), time.process_time()
    state, rest = _performed(task)
    seconds, processor = time.perf_counter() - begin, time.process_time() - spent
    return outcome(task, state, seconds, processor=processor, **rest)


def _performed(task: Task) -> tuple[str, dict[str, Any]]:
    """Return the state and what belongs to it."""
    try:
        cell = _cell(task.cell, task.cell.stat().st_mtime_ns) if task.cell.is_file() else (
            load_cell(task.cell)
        )  # fmt: skip
        return DONE, {"result": task.work(cell, open_log(task.log, cell), task.options)}
    except (ArmError, CellError, LogError) as error:  # they name their file
        return BAD, {"error": _line(error)}
    except GapbridgeError as error:
        return BAD, {"error": f"{task.log}: {_line(error)}"}
    except Exception as error:
        return CRASHED, {
            "error": f"{task.log}: {type(error).__name__}: {_line(error) or 'no message'}",
            "details": traceback.format_exc(),
        }


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


@functools.lru_cache(maxsize=64)
def _cell(path: Path, changed: int) -> Cell:
    """Return a cell, read once by each process."""
    return load_cell(path)


def usable(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the outcomes with a result."""
    return [o for o in outcomes if o.state == DONE]


def by_arm(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Return the usable sessions of each arm: by date where all have one, else by name."""
    found: dict[str, list[Outcome]] = {}
    for outcome in usable(outcomes):
        found.setdefault(outcome.arm, []).append(outcome)
    for arm, sessions in found.items():
        dated = all(o.result["time"] is not None for o in sessions)
        found[arm] = sorted(
            sessions,
            key=lambda o: (o.result["time"] if dated else 0.0, natural(o.session)),
        )
    return {arm: found[arm] for arm in sorted(found, key=natural)}
