"""One run over a fleet: its tasks, and their outcomes from workers and journal."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.document.output_file import printable
from gapbridge.bridge.document.provenance import installed_version
from gapbridge.bridge.fleet.cell_source import CellSource
from gapbridge.bridge.fleet.journal import Journal
from gapbridge.bridge.fleet.session import Fleet, Session, copies, natural_key
from gapbridge.bridge.fleet.task import BAD, CRASHED, DIED, DONE, Outcome, SessionJob, Stamp, Task
from gapbridge.bridge.fleet.workers.workers import Workers
from gapbridge.bridge.report.labels import counted
from gapbridge.core.errors import InputError
from gapbridge.core.files import require_utf8

JOURNAL_VERSION = 3  # format of the results, part of every key
STATES = {BAD: "cannot be used", CRASHED: "failed", DIED: "killed their workers"}


@dataclass(frozen=True)
class FleetRun:
    """The outcomes of a run, in the order of the sessions."""

    outcomes: tuple[Outcome, ...]
    resumed: int  # outcomes from an earlier run
    seconds: float
    workers: str  # description


def make_tasks(
    sessions: Sequence[Session], cells: CellSource, job: SessionJob, options: Mapping[str, Any]
) -> tuple[list[Task], list[Outcome]]:
    """Return the tasks, and the outcomes of sessions without a usable cell or log."""
    tasks, bad = [], []
    stamps: dict[Path, tuple[Stamp, ...]] = {}
    version, copied = installed_version(), copies(sessions)
    for session in sessions:
        task = Task("", session.arm, session.name, session.log, Path(), job, options)
        try:
            if (other := copied.get(session.log)) is not None:
                raise InputError(f"{session.log}: found a copy of {other}, expected each log once")
            cell = cells.cell_of(session)
            for path in (session.log, cell):  # as the tables of results hold them
                require_utf8(path)
            if cell not in stamps:
                stamps[cell] = _cell_stamps(cell)
            complete = replace(task, cell=cell, cell_stamps=stamps[cell])
            tasks.append(replace(complete, key=_key(complete, version)))
        except InputError as error:
            bad.append(task.outcome(BAD, error=" ".join(printable(error).split())))
        except OSError as error:
            text = printable(f"{session.log}: {error.strerror}")
            bad.append(task.outcome(BAD, error=text))
    return tasks, bad


def run(
    tasks: Sequence[Task],
    bad: Sequence[Outcome],
    workers: Workers,
    journal: Journal,
    emit: Callable[[Outcome], None],
) -> FleetRun:
    """Run all tasks without a final outcome in the journal, and journal their outcomes."""
    begin = time.perf_counter()
    outcomes: dict[str, Outcome] = {o.session: o for o in bad}
    pending = []
    for task in tasks:
        earlier = journal.known(task.key)
        if earlier is None or not earlier.final:
            pending.append(task)
        else:
            outcomes[task.session] = earlier
            emit(earlier)
    resumed = len(tasks) - len(pending)
    if pending:
        with workers:
            for outcome in workers.run(pending):
                journal.add(outcome)
                outcomes[outcome.session] = outcome
                emit(outcome)
    ordered = sorted(outcomes.values(), key=lambda o: natural_key(o.session))
    return FleetRun(tuple(ordered), resumed, time.perf_counter() - begin, workers.description())


def _key(task: Task, version: str) -> str:
    """Return a hash of log, cell with the files it names, job, options and Gapbridge's version."""
    job = f"{task.job.__module__}:{task.job.__qualname__}"
    parts = [
        JOURNAL_VERSION, version, job, task.arm, task.session,
        [*_stamps(task.log), *task.cell_stamps], dict(task.options),
    ]  # fmt: skip
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:24]


def _cell_stamps(cell: Path) -> tuple[Stamp, ...]:
    """Return the stamps of a cell and of the files that it names, such as its URDF."""
    try:
        named = [cell.parent / path for _, path in load_cell(cell).file.paths()]
    except InputError:  # the worker reports it
        named = []
    return _stamps(cell, *(path for path in named if path.is_file()))  # a folder's time is its own


def _stamps(*paths: Path) -> tuple[Stamp, ...]:
    """Return path, size (bytes) and time of change (ns) of each file that exists."""
    return tuple(
        (str(path.absolute()), (stat := path.stat()).st_size, stat.st_mtime_ns)
        for path in paths
        if path.exists()
    )


def summary_lines(done: FleetRun, fleet: Fleet) -> list[str]:
    """Return lines with the number of sessions and arms, failures, duration and workers."""
    states = [o.state for o in done.outcomes]
    fresh = len(states) - done.resumed
    lines = [
        f"{counted(len(states), 'session')} of {counted(fleet.arms, 'arm')} ({fleet.rule}): "
        f"{states.count(DONE)} done"
        + "".join(f", {states.count(s)} {w}" for s, w in STATES.items() if s in states)
    ]
    if done.resumed:
        lines.append(f"{done.resumed} of them known from an earlier run")
    if fresh:
        lines.append(f"{done.seconds:.1f} s by {done.workers}")
    return lines
