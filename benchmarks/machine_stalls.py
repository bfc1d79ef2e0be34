"""Moments at which the machine itself stood still: a bare timer on each core, before all else.

A virtual machine's host, or an interrupt, takes cores away for milliseconds. No program on it can
keep a deadline then, and a count of missed deadlines says little without that of such moments.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time
from collections.abc import Collection, Sequence
from typing import Self

PRIORITY = 90  # SCHED_FIFO: before every loop, controller and interrupt thread
EVERY = 0.001  # s between two looks
LATE = 0.0005  # s: a timer that comes later has been kept waiting
Span = tuple[float, float]  # s, monotonic: due and come
Missed = tuple[float, int]  # when the next cycle was seen (s, monotonic), how many were missed


class MachineStalls:
    """Watches every core while the ``with`` block lasts; then ``spans`` has the stalls in order.

    ``cores``: where not those that this thread may use. ``spans`` is None where real-time priority
    is not allowed: then nothing can be said.
    """

    def __init__(self, cores: Collection[int] | None = None) -> None:
        self._cores = cores
        self.spans: list[Span] | None = None
        self._watchers: list[subprocess.Popen[str]] = []

    def __enter__(self) -> Self:
        path = os.pathsep.join(p for p in sys.path if p)
        environment = {**os.environ, "PYTHONPATH": path}
        for core in sorted(self._cores or os.sched_getaffinity(0)):
            command = [sys.executable, "-m", "benchmarks.machine_stalls", str(core)]
            self._watchers.append(
                subprocess.Popen(
                    command,
                    text=True,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    env=environment,
                )
            )
        return self

    def __exit__(self, *_: object) -> None:
        found: list[Span] = []
        allowed = True
        for watcher in self._watchers:
            output, _ = watcher.communicate()  # its standard input ends: so does it
            allowed = allowed and watcher.returncode == 0
            lines = [line.split() for line in output.splitlines()]
            found += [(float(due), float(come)) for due, come in lines]
        self.spans = sorted(found) if allowed else None

    def during(self, begin: float, end: float) -> bool:
        """Return whether a core stood still at any time between two moments (s, monotonic)."""
        return any(due < end and come > begin for due, come in self.spans or ())

    def not_among(self, missed: Sequence[Missed], cycle: float) -> list[Missed]:
        """Return the missed cycles (of ``cycle`` s) during which no core stood still."""
        return [
            (at, count) for at, count in missed if not self.during(at - (count + 2) * cycle, at)
        ]


def watch(core: int) -> list[Span]:
    """Return the stalls of one core until standard input ends. Raises OSError: not allowed."""
    os.sched_setaffinity(0, {core})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    os.set_blocking(0, False)
    gc.disable()
    found: list[Span] = []
    due = time.monotonic()
    look = 0
    while look % 256 or _is_wanted():
        look += 1
        due += EVERY
        time.sleep(max(due - time.monotonic(), 0.0))
        now = time.monotonic()
        if now - due > LATE:
            found.append((due, now))
            due = now
    return found


def _is_wanted() -> bool:
    try:
        return os.read(0, 1) != b""
    except BlockingIOError:
        return True


if __name__ == "__main__":
    try:
        for span in watch(int(sys.argv[1])):
            print(*span)
    except OSError as refused:
        sys.exit(f"machine_stalls: {refused}")
