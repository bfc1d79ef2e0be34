"""A thread that wakes on time although the machine is busy, where that is allowed.

Who measures must not be what is measured: a proxy that sleeps makes faults of its own.
"""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from types import TracebackType
from typing import Self

FIRST = 2  # SCHED_FIFO: before all that has no real-time priority
LATE = 0.03  # s that the machine may be late
KEPT = 10_000  # late wakings that are remembered: more than those of a fault
PRIORITY = 20  # SCHED_FIFO; below the loop's and the simulated controller's


def be_punctual() -> None:
    """Take real-time priority for the calling thread alone, not for what it starts."""
    with contextlib.suppress(OSError, AttributeError):
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))


def be_ordinary() -> None:
    """Give real-time priority back: what a thread does later must not keep others from the core."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def go_first(pid: int | None = None) -> None:
    """Have a process, or what the calling thread starts, go before other work, where allowed.

    A loop that is started anew a hundred times must not wait for half a minute each time.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(pid or 0, os.SCHED_FIFO, os.sched_param(FIRST))


class Witness:
    """Measures how late threads of this process wake, one on each core.

    What disturbs them is the machine's, and no fault. A host may stop one core and not the others.
    They have no priority: neither have some threads of a rig, such as those of libraries.
    """

    TICK = 0.002  # s

    def __init__(self) -> None:
        self._late: list[tuple[float, float]] = []  # s monotonic: when it woke; s: how late
        self._over = threading.Event()
        self._threads = [
            threading.Thread(target=self._watch, args=(core,), daemon=True, name=f"witness {core}")
            for core in os.sched_getaffinity(0)
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._over.set()
        for thread in self._threads:
            thread.join()

    def late(self, since: float, limit: float = LATE, until: float = math.inf) -> float:
        """Return how late the machine was in a span (s monotonic), s; 0 if within ``limit``."""
        span = [late for woke, late in list(self._late) if woke > since and woke - late < until]
        worst = max(span, default=0.0)
        return worst if worst > limit else 0.0

    def _watch(self, core: int) -> None:
        os.sched_setaffinity(0, {core})  # of this thread
        be_ordinary()
        before = time.monotonic()
        while not self._over.wait(self.TICK):
            now = time.monotonic()
            if now - before > 2.0 * self.TICK:
                self._late.append((now, now - before - self.TICK))
                del self._late[:-KEPT]
            before = now
