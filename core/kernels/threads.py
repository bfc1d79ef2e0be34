"""Ranges of rows on several threads: the loops hold no lock of the interpreter.

Threads of our own, made per call: a pool of numba's would not survive a fork, and their making
(some 0.1 ms) is nothing beside the rows from which they pay.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import TypeVar

from gapbridge.core.kernels.layout import LANES

Result = TypeVar("Result")
FEWEST = 100 * LANES  # rows of one thread from which it pays


def processors() -> int:
    """Return how many processors this process may use; GAPBRIDGE_THREADS sets fewer."""
    given = os.environ.get("GAPBRIDGE_THREADS", "")
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(min(int(given) if given.isdigit() else 64, count or 1), 1)


def in_ranges(work: Callable[[int, int], Result], count: int) -> list[Result]:
    """Return the results of ``work(first, last)`` for ranges of ``count`` rows, in order."""
    parts = max(min(processors(), count // FEWEST), 1)
    if parts == 1:
        return [work(0, count)]
    step = -(-count // (parts * LANES)) * LANES
    ranges = [(first, min(first + step, count)) for first in range(0, count, step)]
    results: dict[int, Result] = {}
    failures: list[BaseException] = []

    def run(k: int) -> None:
        try:
            results[k] = work(*ranges[k])
        except BaseException as failure:
            failures.append(failure)

    threads = [threading.Thread(target=run, args=(k,)) for k in range(1, len(ranges))]
    for thread in threads:
        thread.start()
    run(0)
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]
    return [results[k] for k in range(len(ranges))]
