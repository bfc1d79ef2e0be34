"""Local workers: spawned processes that run one session at a time.

Every process has its own pipe, so that the task of a dead one is known; a ProcessPoolExecutor
would fail as a whole.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from gapbridge.bridge.fleet.task import MAX_DEATHS, Outcome, Task, run_task
from gapbridge.bridge.fleet.workers.workers import Workers
from gapbridge.core.errors import RunError

VARIABLES = (
    # one thread per process: threads do not speed up matrices of this size
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS",
    "PYTHONSAFEPATH",  # else ``python -c`` imports first what lies in the working folder
)  # fmt: skip
"""Environment variables of every process, set to 1."""
MAX_FAILED_STARTS = 3  # in a row, after which the run fails
READY = "ready"
QUEUED = 2  # tasks sent to a process, so that it never waits
MIN_TASKS_PER_PROCESS = 4  # pending, for QUEUED tasks at once


@dataclass
class _Worker:
    """One process and its tasks."""

    process: BaseProcess
    pipe: Connection
    ready: bool = False
    tasks: deque[Task] = field(default_factory=deque)  # the first is running

    def set_ready(self) -> None:
        """Mark the process as ready for tasks."""
        self.ready = True


class LocalWorkers(Workers):
    """Processes on this machine."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._workers: list[_Worker] = []
        self._failed_starts = 0
        self._deaths_by_task: dict[str, int] = {}

    def description(self) -> str:
        """Return the number of processes."""
        return f"{self.count} local process{'es' if self.count > 1 else ''}"

    def start(self) -> None:
        """Spawn the processes."""
        self._workers = [_spawn() for _ in range(self.count)]

    def stop(self) -> None:
        """End the processes."""
        for worker in self._workers:
            worker.pipe.close()
            worker.process.kill()
        for worker in self._workers:
            worker.process.join()
        self._workers = []

    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Yield the outcomes as they finish; another process repeats the task of a dead one."""
        pending = deque(tasks)
        while True:
            for worker in self._workers:
                most = QUEUED if len(pending) > MIN_TASKS_PER_PROCESS * self.count else 1
                while worker.ready and pending and len(worker.tasks) < most:
                    _send(worker, pending.popleft())
            if not pending and not any(w.tasks for w in self._workers):
                return
            for result in self._received():
                if isinstance(result, Outcome):
                    yield result
                else:
                    pending.appendleft(result)

    def _received(self) -> Iterator[Outcome | Task]:
        """Wait for messages; yield outcomes, and tasks of dead processes to repeat."""
        by_pipe = {worker.pipe: worker for worker in self._workers}
        for pipe in wait(list(by_pipe)):
            assert isinstance(pipe, Connection)
            worker = by_pipe[pipe]
            try:
                message = pipe.recv()
            except (EOFError, OSError):
                yield from self._replace(worker)
                continue
            if message == READY:
                worker.set_ready()
                self._failed_starts = 0
                continue
            worker.tasks.popleft()
            yield message

    def _replace(self, worker: _Worker) -> Iterator[Outcome | Task]:
        """Replace a dead process; yield its tasks to repeat, or the outcome of a fatal one."""
        worker.pipe.close()
        worker.process.join()
        if not worker.ready:
            self._failed_starts += 1
            if self._failed_starts >= MAX_FAILED_STARTS:
                raise RunError(
                    f"{MAX_FAILED_STARTS} local processes died while starting (exit code "
                    f"{worker.process.exitcode}), expected them to start"
                )
        self._workers[self._workers.index(worker)] = _spawn()
        if not worker.tasks:
            return
        task, *waiting = worker.tasks
        yield from waiting
        self._deaths_by_task[task.key] = self._deaths_by_task.get(task.key, 0) + 1
        yield task.died_outcome() if self._deaths_by_task[task.key] >= MAX_DEATHS else task


def _spawn() -> _Worker:
    context = multiprocessing.get_context("spawn")
    pipe, worker_pipe = context.Pipe()
    before = {name: os.environ.get(name) for name in VARIABLES}
    os.environ.update(dict.fromkeys(VARIABLES, "1"))
    try:
        process = context.Process(target=_serve, args=(worker_pipe,), daemon=True)
        process.start()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    worker_pipe.close()
    return _Worker(process, pipe)


def _send(worker: _Worker, task: Task) -> None:
    """Send a task; the death of the process is noticed at the next receive."""
    worker.tasks.append(task)
    try:
        worker.pipe.send(task)
    except OSError:
        return


def _serve(pipe: Connection) -> None:
    """Run tasks until the pipe is closed."""
    # Ctrl-C reaches every process of the terminal; the parent handles it
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        pipe.send(READY)
        while True:
            pipe.send(run_task(pipe.recv()))
    except (EOFError, OSError):
        return
