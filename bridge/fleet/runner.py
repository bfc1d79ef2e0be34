"""One run over a fleet: which sessions are to be done, who does them, what came of all."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gapbridge.bridge.fleet.cell_source import CellSource
from gapbridge.bridge.fleet.journal import Journal
from gapbridge.bridge.fleet.session import Found, Session, natural
from gapbridge.bridge.fleet.task import BAD, CRASHED, DIED, DONE, Outcome, Task, Work, outcome
from gapbridge.bridge.fleet.workers.workers import Workers
from gapbridge.bridge.report.labels import counted
from gapbridge.core.errors import InputError

FORM = 2  # of the results: another form is another key
STATES = {
    BAD: "cannot be used",
    CRASHED: "failed",
    DIED: "killed their workers",
}


@dataclass(frozen=True)
class Done:
    """What came of a run, in the order of the sessions."""

    outcomes: tuple[Outcome, ...]
    resumed: int  # taken from an earlier run
    seconds: float
    who: str  # did the work


def tasks_of(
    sessions: Sequence[Session], cells: CellSource, work: Work, options: Mapping[str, Any]
) -> tuple[list[Task], list[Outcome]]:
    """Return the tasks, and the outcomes of sessions that have no cell or no log."""
    tasks, bad = [], []
    for session in sessions:
        task = Task("", session.arm, session.name, session.log, Path(), work, options)
        try:
            cell = cells.cell_of(session)
            key = _key(session, cell, work, options)
            tasks.append(Task(key, session.arm, session.name, session.log, cell, work, options))
        except InputError as error:
            bad.append(outcome(task, BAD, error=" ".join(str(error).split())))
        except OSError as error:
            bad.append(outcome(task, BAD, error=f"{session.log}: {error.strerror}"))
    return tasks, bad


def run(
    tasks: Sequence[Task],
    bad: Sequence[Outcome],
    workers: Workers,
    journal: Journal,
    emit: Callable[[Outcome], None],
) -> Done:
    """Do all tasks that the journal does not know; every outcome is in the journal as it comes."""
    begin = time.perf_counter()
    outcomes: dict[str, Outcome] = {o.session: o for o in bad}
    left = []
    for task in tasks:
        before = journal.known(task.key)
        if before is None or not before.final:
            left.append(task)
        else:
            outcomes[task.session] = before
            emit(before)
    resumed = len(tasks) - len(left)
    if left:
        with workers:
            for found in workers.run(left):
                journal.add(found)
                outcomes[found.session] = found
                emit(found)
    ordered = sorted(outcomes.values(), key=lambda o: natural(o.session))
    return Done(tuple(ordered), resumed, time.perf_counter() - begin, workers.description())


def _key(session: Session, cell: Path, work: Work, options: Mapping[str, Any]) -> str:
    """Return a key that changes when log, cell, work or options do."""
    stamps = [
        (str(path.absolute()), (stat := path.stat()).st_size, stat.st_mtime_ns)
        for path in (session.log, cell)
        if path.exists()
    ]
    parts = [FORM, f"{work.__module__}:{work.__qualname__}", session.arm, session.name, stamps,
            dict(options)]  # fmt: skip
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:24]


def ending(done: Done, found: Found) -> list[str]:
    """Return the lines: how many, whose, by whom, how long; what was skipped."""
    states = [o.state for o in done.outcomes]
    fresh = len(states) - done.resumed
    lines = [
        f"{counted(len(states), 'session')} of {counted(found.arms, 'arm')} ({found.rule}): "
        f"{states.count(DONE)} done"
        + "".join(f", {states.count(s)} {w}" for s, w in STATES.items() if s in states)
    ]
    if done.resumed:
        lines.append(f"{done.resumed} of them known from an earlier run")
    if fresh:
        lines.append(f"{done.seconds:.1f} s by {done.who}")
    return lines
