"""How a fleet's cost grows with its sessions: bare loops, local processes, a Dask cluster.

All run in turns over the same chunks of sessions, so that what else the machine does meets all of
them alike; ratios are of a chunk's times, reported as the median with the quartiles.
"""

from __future__ import annotations

import shutil
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import psutil
from threadpoolctl import threadpool_limits

from benchmarks.fleet.simulating import write_fleet
from gapbridge.bridge.fleet.cell_source import OneCell
from gapbridge.bridge.fleet.journal import Journal
from gapbridge.bridge.fleet.runner import make_tasks, run
from gapbridge.bridge.fleet.session import find_sessions
from gapbridge.bridge.fleet.session_work import fit_session
from gapbridge.bridge.fleet.task import DONE, Outcome, Task, run_task
from gapbridge.bridge.fleet.workers.dask_workers import DaskWorkers
from gapbridge.bridge.fleet.workers.local_workers import LocalWorkers
from gapbridge.bridge.fleet.workers.workers import Workers
from gapbridge.drivers.clock import SYSTEM

WORKERS = 2
POSES = 10
BARE = "bare loops side by side"  # as many as there are workers: what the machine allows
Way = Callable[[Sequence[Task]], None]


class Kept(Workers):
    """Workers that stay when a run over them ends: their start is measured by itself."""

    def __init__(self, inner: Workers) -> None:
        self.inner = inner

    def start(self) -> None:
        """Leave them."""

    def stop(self) -> None:
        """Leave them."""

    def run(self, tasks: Any) -> Iterator[Outcome]:
        """Do the tasks."""
        return self.inner.run(tasks)

    def message(self) -> str:
        """Return who they are."""
        return self.inner.message()


def measure(folder: Path, sessions: int, chunk: int, seed: int, *, dask: bool) -> dict[str, Any]:
    """Return times and ratios for so many sessions."""
    cell, _ = write_fleet(folder, [[POSES]] * sessions, seed)
    found = find_sessions([str(folder / "logs")])
    tasks, _ = make_tasks(found.sessions, OneCell(cell), fit_session, {})
    chunks = [tasks[i : i + chunk] for i in range(0, len(tasks), chunk)]
    with ExitStack() as stack:
        ways, started, below = _ways(folder, stack, dask=dask)
        for way in ways.values():
            way(tasks[: 2 * WORKERS])  # kernels loaded, files in memory: each meets the same
        times: dict[str, list[float]] = {name: [] for name in ways}
        spent: dict[str, list[float]] = {name: [] for name in ways}
        for i, part in enumerate(chunks):
            names = list(ways)
            for name in names[i % len(names) :] + names[: i % len(names)]:
                begin, before = time.perf_counter(), _processor_time(below[name])
                ways[name](part)
                times[name].append(time.perf_counter() - begin)
                spent[name].append(_processor_time(below[name]) - before)
    sizes = [len(c) for c in chunks]
    return {
        "sessions": sessions, "chunk": chunk, "poses": POSES, "started_s": started,
        "per_session_ms": {
            name: _spread([1e3 * t / n for t, n in zip(ts, sizes, strict=True)])
            for name, ts in times.items()
        },
        "processor_ms": {
            name: _spread([1e3 * t / n for t, n in zip(ts, sizes, strict=True)])
            for name, ts in spent.items()
        },
        "processor_overhead": _ratios(spent, "loop", set(spent) - {"loop"}, over=True),
        "faster_than_loop": _ratios(times, "loop", {BARE, "processes", "dask"}),
        "faster_than_one_process": _ratios(times, "one process", {"processes"}),
        "overhead": {
            name: _spread([t / b - 1 for t, b in zip(times[name], times["loop"], strict=True)])
            for name in times if name.startswith("one ")
        },
    }  # fmt: skip


def _ways(
    folder: Path, stack: ExitStack, *, dask: bool
) -> tuple[dict[str, Way], dict[str, float], dict[str, set[int]]]:
    """Return what does a chunk, by name, how long it took to start, and its processes."""
    started: dict[str, float] = {}
    ways: dict[str, Way] = {"loop": _loop}
    below: dict[str, set[int]] = {"loop": set()}
    journal = folder / "journal"

    def add(name: str, workers: Workers, begin: float, before: set[int]) -> None:
        ways[name] = _pool(Kept(stack.enter_context(workers)), journal)
        ways[name]([])
        started[name] = time.perf_counter() - begin
        below[name] = _children() - before

    before = _children()
    pool = stack.enter_context(get_context("spawn").Pool(WORKERS))

    def side_by_side(tasks: Sequence[Task]) -> None:
        pool.map(_loop, [tasks[k::WORKERS] for k in range(WORKERS)], 1)

    ways[BARE] = side_by_side
    ways[BARE]([])
    below[BARE] = _children() - before
    for name, count in (("one process", 1), ("processes", WORKERS)):
        add(name, LocalWorkers(count), time.perf_counter(), _children())
    if dask:
        for name, count in (("one dask worker", 1), ("dask", WORKERS)):
            begin, before = time.perf_counter(), _children()
            add(name, DaskWorkers(stack.enter_context(cluster(count))), begin, before)
    return ways, started, below


def _loop(tasks: Sequence[Task]) -> None:
    """Do the tasks one after the other, here: the bare work, nothing kept."""
    with threadpool_limits(1, "blas"):
        for task in tasks:
            assert run_task(task).state == DONE


def _pool(workers: Workers, journal: Path) -> Way:
    def way(tasks: Sequence[Task]) -> None:
        with Journal(journal, SYSTEM, fresh=True) as book:
            done = run(tasks, [], workers, book, lambda outcome: None)
        assert all(o.state == DONE for o in done.outcomes)

    return way


@contextmanager
def cluster(workers: int) -> Iterator[str]:
    """Give the address of a Dask cluster on this machine."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=workers, threads_per_worker=1, host="127.0.0.1", protocol="tcp",
        dashboard_address=None, silence_logs=50,
    ) as made:  # fmt: skip
        yield made.scheduler_address


def whole(folder: Path, sessions: int, seed: int) -> float:
    """Return the time (s) of a whole run on two processes, their start included."""
    shutil.rmtree(folder, ignore_errors=True)
    cell, _ = write_fleet(folder, [[POSES]] * sessions, seed)
    begin = time.perf_counter()
    found = find_sessions([str(folder / "logs")])
    tasks, _ = make_tasks(found.sessions, OneCell(cell), fit_session, {})
    with Journal(folder / "journal", SYSTEM, fresh=True) as book:
        run(tasks, [], LocalWorkers(WORKERS), book, lambda outcome: None)
    return time.perf_counter() - begin


def _children() -> set[int]:
    return {p.pid for p in psutil.Process().children(recursive=True)}


def _processor_time(processes: set[int]) -> float:
    """Return the processor time (s) of this thread and of a way's processes.

    On a machine that others use this says what a way costs where the clock on the wall cannot. A
    Dask cluster's scheduler and client run in other threads of this process and are left out.
    """
    below = (psutil.Process(pid).cpu_times() for pid in processes)
    return time.thread_time() + sum(t.user + t.system for t in below)


def _ratios(
    times: dict[str, list[float]], peer: str, names: set[str], *, over: bool = False
) -> dict[str, Any]:
    """Return how many times faster than the peer, or by what share dearer."""
    return {
        name: _spread([
            t / b - 1 if over else b / t for t, b in zip(times[name], times[peer], strict=True)
        ])
        for name in times if name in names
    }  # fmt: skip


def _spread(values: Sequence[float]) -> dict[str, float]:
    """Return the median and the quartiles."""
    if len(values) < 2:
        return {"median": values[0], "low": values[0], "high": values[0]}
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return {"median": middle, "low": low, "high": high}
