"""The daemon's output, written by a thread of its own.

A terminal that is stopped (Ctrl-S) or a pipe that nobody reads blocks who writes to it: no disarm
may wait for that.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable
from typing import TypeVar

from gapbridge.drivers.clock import Clock

MOST_WAITING = 10_000  # lines; further ones are left out and counted
T = TypeVar("T")


class Output:
    """Lines that wait to be written, in order. ``say`` writes how many were left out."""

    def __init__(self, say: Callable[[str], None], clock: Clock) -> None:
        self._say, self._clock = say, clock
        self._waiting: queue.Queue[Callable[[], None] | None] = queue.Queue(MOST_WAITING)
        self._left_out, self._counting = 0, threading.Lock()
        self._written = threading.Event()
        threading.Thread(target=self._write, name="output", daemon=True).start()

    def behind(self, write: Callable[[T], None]) -> Callable[[T], None]:
        """Return a function that has the thread call ``write``, and never blocks."""

        def put(line: T) -> None:
            try:
                self._waiting.put_nowait(lambda: write(line))
            except queue.Full:
                with self._counting:
                    self._left_out += 1

        return put

    def close(self, seconds: float) -> bool:
        """Wait until all is written, ``seconds`` at most; returns whether it is."""
        try:
            self._waiting.put_nowait(None)
        except queue.Full:
            return False
        return self._clock.wait(self._written, seconds)

    def _write(self) -> None:
        while (line := self._waiting.get()) is not None:
            self._try(line)
            with self._counting:
                count, self._left_out = self._left_out, 0
            if count:
                self._try(lambda n=count: self._say(f"{n} lines left out: output was blocked"))  # type: ignore[misc]
        self._written.set()

    @staticmethod
    def _try(line: Callable[[], None]) -> None:
        with contextlib.suppress(OSError, ValueError):  # its reader has left: the daemon stays
            line()
