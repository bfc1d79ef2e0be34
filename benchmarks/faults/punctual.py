"""A thread that wakes on time although the machine is busy, where that is allowed.

Who measures must not be what is measured: a proxy that sleeps makes faults of its own.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from types import TracebackType
from typing import Self

FIRST = 2  # SCHED_FIFO: before all that has no real-time priority
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
    """Measures how late this process wakes: what disturbs it is the machine's, and no fault."""

    TICK = 0.002  # s

    def __init__(self) -> None:
        self.latest = 0.0  # s behind a tick, the worst
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True, name="witness")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        be_punctual()
        before = time.monotonic()
        while not self._over.wait(self.TICK):
            now = time.monotonic()
            self.latest, before = max(self.latest, now - before - self.TICK), now
