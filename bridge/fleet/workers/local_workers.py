"""Local workers: spawned processes that do one session at a time.

A pool of the standard library breaks as a whole when one of its processes dies and cannot say
over which task; here every process has its own pipe, so that the task in it is known.
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

from gapbridge.bridge.fleet.task import DEATHS, Outcome, Task, died, perform
from gapbridge.bridge.fleet.workers.workers import Workers
from gapbridge.core.errors import RunError

# matrices of this size gain nothing from threads, which only get in each other's way
SINGLE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
STILLBORN = 3  # processes that die before they are ready, one after the other: give up
READY = "ready"
AHEAD = 2  # tasks that a process has, so that it never waits for the next
PLENTY = 4  # tasks per process from which on it gets more than one: at the end all share


@dataclass
class _Worker:
    """One process and what it is at."""

    process: BaseProcess
    pipe: Connection
    ready: bool = False
    tasks: deque[Task] = field(default_factory=deque)  # the first is being done, others wait

    def come_up(self) -> None:
        """Take tasks from now on."""
        self.ready = True


class LocalWorkers(Workers):
    """Processes on this machine."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._workers: list[_Worker] = []
        self._stillborn = 0
        self._deaths: dict[str, int] = {}

    def description(self) -> str:
        """Return how many there are."""
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
        """Give the outcomes as they come; a dead process's task is done again by another."""
        left = deque(tasks)
        while True:
            for worker in self._workers:
                most = AHEAD if len(left) > PLENTY * self.count else 1
                while worker.ready and left and len(worker.tasks) < most:
                    _give(worker, left.popleft())
            if not left and not any(w.tasks for w in self._workers):
                return
            for found in self._received():
                if isinstance(found, Outcome):
                    yield found
                else:
                    left.appendleft(found)

    def _received(self) -> Iterator[Outcome | Task]:
        """Wait; give outcomes, and tasks whose process has died and that are to be done again."""
        by_pipe = {worker.pipe: worker for worker in self._workers}
        for pipe in wait(list(by_pipe)):
            assert isinstance(pipe, Connection)
            worker = by_pipe[pipe]
            try:
                message = pipe.recv()
            except (EOFError, OSError):
                yield from self._replaced(worker)
                continue
            if message == READY:
                worker.come_up()
                self._stillborn = 0
                continue
            worker.tasks.popleft()
            yield message

    def _replaced(self, worker: _Worker) -> Iterator[Outcome | Task]:
        worker.pipe.close()
        worker.process.join()
        if not worker.ready:
            self._stillborn += 1
            if self._stillborn >= STILLBORN:
                raise RunError(
                    f"{STILLBORN} local processes died while starting (exit code "
                    f"{worker.process.exitcode}), expected them to come up"
                )
        self._workers[self._workers.index(worker)] = _spawn()
        if not worker.tasks:
            return
        task, *waiting = worker.tasks
        yield from waiting
        self._deaths[task.key] = self._deaths.get(task.key, 0) + 1
        yield died(task) if self._deaths[task.key] >= DEATHS else task


def _spawn() -> _Worker:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    before = {name: os.environ.get(name) for name in SINGLE}
    os.environ.update(dict.fromkeys(SINGLE, "1"))
    try:
        process = context.Process(target=_serve, args=(there,), daemon=True)
        process.start()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    there.close()
    return _Worker(process, here)


def _give(worker: _Worker, task: Task) -> None:
    """Send a task; a process that has just died is found out by whoever listens next."""
    worker.tasks.append(task)
    try:
        worker.pipe.send(task)
    except OSError:
        return


def _serve(pipe: Connection) -> None:
    """Do tasks until the other end is gone."""
    # the terminal's Ctrl-C reaches every process: who has started this one decides
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        pipe.send(READY)
        while True:
            pipe.send(perform(pipe.recv()))
    except (EOFError, OSError):
        return
