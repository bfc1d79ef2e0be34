"""What the daemon and its loop process share: heartbeat, commands, events, statistics, rows.

One block of anonymous memory that the daemon makes and the loop's process inherits. It outlives the
loop's process, however that ends. Each field has one writer, so there are no locks: rows and events
are published by a counter that is raised after they are complete.
"""

from __future__ import annotations

import json
import mmap
import os
import sys
import tempfile
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ROWS = 8192  # 16 s at 500 Hz: how long the daemon may be held up before rows are lost
EVENTS, EVENT_BYTES = 64, 512
BINS, BIN = 20_000, 5e-6  # s: histograms reach to 100 ms, the last bin holds what is beyond

_HEADER = np.dtype(
    [
        ("beat", "f8"),  # s, monotonic: last sign of life of the loop
        ("allowed", "f8"),  # s it may take to the next one
        ("state", "i8"),  # of State
        ("rows", "i8"),  # written so far
        ("events", "i8"),  # written so far
        ("cycles", "i8"),  # distinct controller timestamps
        ("missed", "i8"),  # controller cycles between them that were never seen
        ("span", "f8"),  # s of the controller's clock that cycles and missed are counted over
        ("written", "i8"),  # setpoints
        ("invalid", "i8"),  # samples that could not be believed
        ("torn", "i8"),  # samples that were read again
        ("unsolved", "i8"),  # cycles without a correction: no pose could be reached
        ("ended", "i8"),  # 1: the source has come to its end
        ("stop", "i8"),  # 1: ramp out and end (written by the daemon)
        ("clamps", "i8", (5,)),
    ]
)


@dataclass(frozen=True)
class Event:
    """One change of state."""

    before: str
    after: str
    cause: str
    detail: str
    time: float  # s, monotonic


class SharedBlock:
    """The block, seen from either side. ``file`` may be inherited by a child process."""

    def __init__(self, width: int, file: int | None = None) -> None:
        size = _HEADER.itemsize + EVENTS * EVENT_BYTES + 8 * (2 * BINS + ROWS * width)
        self._owned = file is None
        self.file = _anonymous_file(size) if file is None else file
        self._map = mmap.mmap(self.file, size)
        head = np.frombuffer(self._map, _HEADER, 1)
        self.fields = head[0]
        at = _HEADER.itemsize
        self._events = np.frombuffer(self._map, f"S{EVENT_BYTES}", EVENTS, at)
        at += EVENTS * EVENT_BYTES
        counts = np.frombuffer(self._map, np.int64, 2 * BINS, at).reshape(2, BINS)
        self.ages, self.works = counts  # histograms over BIN
        at += 16 * BINS
        self.ring: NDArray[np.float64] = np.frombuffer(
            self._map, np.float64, ROWS * width, at
        ).reshape(ROWS, width)
        self._taken = 0
        self._told = 0
        self.dropped = 0  # rows overwritten before they were drained

    def beat(self, allowed: float) -> None:
        """Say that the loop lives, and that the next sign comes within ``allowed`` s."""
        self.fields["allowed"] = allowed
        self.fields["beat"] = time.monotonic()

    @property
    def hangs(self) -> bool:
        """Return whether the loop's sign of life is overdue."""
        late = time.monotonic() - float(self.fields["beat"])
        return late > float(self.fields["allowed"])

    def tell(self, event: Event) -> None:
        """Publish an event (loop's side)."""
        words = [event.before, event.after, event.cause, event.detail[:300], event.time]
        text = json.dumps(words).encode()
        if len(text) >= EVENT_BYTES:
            text = json.dumps([*words[:3], event.detail[:60], event.time]).encode()
        self._events[int(self.fields["events"]) % EVENTS] = text
        self.fields["events"] += 1

    def heard(self) -> list[Event]:
        """Return the events since the last call (daemon's side)."""
        last = int(self.fields["events"])
        first = max(self._told, last - EVENTS)
        self._told = last
        return [Event(*json.loads(bytes(self._events[i % EVENTS]))) for i in range(first, last)]

    def drain(self) -> NDArray[np.float64]:
        """Return a copy of the rows since the last call (daemon's side)."""
        last = int(self.fields["rows"])
        first = max(self._taken, last - ROWS + 64)  # a margin: the loop goes on writing
        self.dropped += first - self._taken
        self._taken = last
        if first == last:
            return self.ring[:0].copy()
        return np.take(self.ring, np.arange(first, last) % ROWS, axis=0)

    def quantile(self, counts: NDArray[np.int64], share: float) -> float:
        """Return the quantile of a histogram, s; NaN of an empty one."""
        total = int(counts.sum())
        if not total:
            return float("nan")
        index = int(np.searchsorted(np.cumsum(counts), share * total))
        return (min(index, BINS - 1) + 1) * BIN

    def close(self) -> None:
        """Give the memory back; may be repeated."""
        if self._owned and self.file >= 0:
            os.close(self.file)
            self.file = -1


def _anonymous_file(size: int) -> int:
    """Return the descriptor of a file without a name; in memory where the system has such."""
    if sys.platform == "linux":
        file = os.memfd_create("gapbridge")
    else:
        with tempfile.TemporaryFile() as found:
            file = os.dup(found.fileno())
    os.ftruncate(file, size)
    return file
