"""Memory shared by the loop's process, its parent and who reads along: heartbeat, commands, cycles.

One page lives as long as the daemon; processes of the loop come and go. One writer for each word, 8
bytes each, and no locks: whichever side dies, stands still or is killed, the others go on. Cycles
go through a ring; each row begins with its own number, so that a reader knows a row that is not
whole, or was overwritten. Who only reads gets a descriptor that cannot be written to.
"""

from __future__ import annotations

import mmap
import os
import tempfile
import time
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from bridge.ipc.counts import Count

Array = NDArray[np.float64]
WORDS = 128
ROWS = 8192  # cycles kept: 16 s at 500 Hz
# words; the heartbeat's time is a float in a word of its own
_BEATS, _PHASE, _STATE, _COMMAND, _WRITTEN, _ENDED, _SEEN = range(7)
_BEAT_TIME = 32
_COUNTS = 64  # from here on one word for each Count, over all processes of the loop


class Phase(IntEnum):
    """What the loop's process is at; each may take a different time without a heartbeat."""

    STARTING = 0  # imports, compilation
    CONNECTING = 1  # constructors of the robot's library, which can hang for ever
    RUNNING = 2
    ARMING = 3
    ENDING = 4


class Command(IntEnum):
    """What the parent asks for."""

    NONE = 0
    ARM = 1
    DISARM = 2
    STOP = 3


def slices_of(n: int) -> dict[str, slice]:
    """Return where each field of a cycle stands in its row: 1, n, 3 or 6 numbers, n joints."""
    found, at = {}, 0
    for name, size in (
        ("number", 1), ("timestamp", 1), ("state", 1), ("written", 1), ("missed", 1),
        ("age", 1), ("duration", 1), ("clamped", 1), ("residual", 1),
        ("target_q", n), ("actual_q", n), ("actual_qd", n), ("actual_current_as_torque", n),
        ("joint_temperatures", n), ("payload", 1), ("payload_cog", 3),
        ("actual_TCP_force", 6), ("ft_raw_wrench", 6),
        ("nominal_q", n), ("corrected_q", n), ("offset", 6),
        ("received", 1), ("flags", 1), ("robot_mode", 1), ("safety_mode", 1),
        ("runtime_state", 1), ("safety_status_bits", 1), ("speed_scaling", 1), ("own_q", n),
        ("attempted", 1), ("ramp_time", 1), ("rate", 1), ("loop", 1),
    ):  # fmt: skip
        found[name] = slice(at, at + size)
        at += size
    return found


class Page:
    """The shared memory, seen from any side.

    Without ``fd`` it is made; with one it is joined, for reading only unless ``writable``.
    """

    def __init__(self, n: int, fd: int | None = None, writable: bool = True) -> None:
        self.n = n
        self.slices = slices_of(n)
        self.width = max(part.stop for part in self.slices.values())
        size = 8 * (WORDS + ROWS * self.width)
        self.fd = _anonymous(size) if fd is None else fd
        access = mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ
        self._map = mmap.mmap(self.fd, size, access=access)
        self._words = np.frombuffer(self._map, np.int64, WORDS)
        self._times = np.frombuffer(self._map, np.float64, WORDS)
        rows = np.frombuffer(self._map, np.float64, ROWS * self.width, 8 * WORDS)
        self._rows = rows.reshape(ROWS, self.width)

    # -- the loop's side --------------------------------------------------------------------------

    def beat(self) -> None:
        """Tell that the loop is alive."""
        self._times[_BEAT_TIME] = time.monotonic()
        self._words[_BEATS] += 1

    def enter(self, phase: Phase) -> None:
        """Tell what comes next."""
        self.beat()
        self._words[_PHASE] = phase

    def tell_state(self, state: int) -> None:
        """Tell the supervisor's state."""
        self._words[_STATE] = state

    def tell_ended(self) -> None:
        """Tell that the source has come to its end."""
        self._words[_ENDED] = 1

    def tell_seen(self) -> None:
        """Tell that a state has been read: the link works."""
        self._words[_SEEN] = 1

    def count(self, what: Count, times: int = 1) -> None:
        """Count an event."""
        self._words[_COUNTS + what] += times

    def next_row(self) -> Array:
        """Return the row of the next cycle, to be filled from column 1 on."""
        row: Array = self._rows[self._words[_WRITTEN] % ROWS]
        row[0] = -1.0
        return row

    def publish(self) -> None:
        """Hand the filled row over."""
        written = int(self._words[_WRITTEN])
        self._rows[written % ROWS, 0] = written
        self._words[_WRITTEN] = written + 1

    def take_command(self) -> Command:
        """Return what the parent asks for, once; STOP stays."""
        command = Command(int(self._words[_COMMAND]))
        if command in (Command.ARM, Command.DISARM):
            self._words[_COMMAND] = Command.NONE
        return command

    # -- the parent's side ------------------------------------------------------------------------

    def renew(self) -> None:
        """Make ready for a new process of the loop, the former being dead; cycles go on."""
        self._times[_BEAT_TIME] = 0.0
        for word in (_BEATS, _PHASE, _STATE, _COMMAND, _ENDED, _SEEN):
            self._words[word] = 0

    def open_for_reading(self) -> int:
        """Return a further descriptor of the page, to be closed by the caller; read-only."""
        path = f"/proc/self/fd/{self.fd}"
        return os.open(path, os.O_RDONLY) if os.path.exists(path) else os.dup(self.fd)

    def ask(self, command: Command) -> None:
        """Ask the loop for something; STOP is never taken back."""
        if self._words[_COMMAND] != Command.STOP:
            self._words[_COMMAND] = command

    @property
    def phase(self) -> Phase:
        """Return what the loop's process is at."""
        return Phase(int(self._words[_PHASE]))

    @property
    def state(self) -> int:
        """Return the supervisor's state."""
        return int(self._words[_STATE])

    @property
    def ended(self) -> bool:
        """Return whether the source has come to its end."""
        return bool(self._words[_ENDED])

    @property
    def seen(self) -> bool:
        """Return whether a state has been read."""
        return bool(self._words[_SEEN])

    @property
    def silence(self) -> float:
        """Return s since the last heartbeat; 0 before the first."""
        beat = float(self._times[_BEAT_TIME])
        return time.monotonic() - beat if beat else 0.0

    @property
    def written(self) -> int:
        """Return how many cycles have been handed over since the daemon's start."""
        return int(self._words[_WRITTEN])

    def counts(self) -> dict[str, int]:
        """Return how often each Count has happened since the daemon's start."""
        return {what.words: int(self._words[_COUNTS + what]) for what in Count}

    def reader(self, first: int = 0) -> PageReader:
        """Return a reader of its own cursor that begins at row number ``first``."""
        return PageReader(self, first)

    def rows(self, first: int, last: int) -> tuple[Array, int]:
        """Return copies of the rows (k, width) of numbers first..last-1, and how many are gone."""
        oldest = max(first, last - ROWS + ROWS // 8)  # what is older may be under the pen
        index = np.arange(oldest, last)
        places = index % ROWS
        rows = self._rows[places]
        whole = (rows[:, 0] == index) & (self._rows[places, 0] == index)
        return rows[whole], oldest - first + int((~whole).sum())

    def close(self) -> None:
        """Let go of the memory."""
        self._words = self._times = np.empty(0)  # type: ignore[assignment]
        self._rows = np.empty((0, 0))
        self._map.close()
        os.close(self.fd)


class PageReader:
    """One reader of a page's cycles; any number of them read side by side."""

    def __init__(self, page: Page, first: int) -> None:
        self._page = page
        self.next = first  # number of the first row that it has not read
        self.lost = 0  # rows overwritten before they were read

    def drain(self) -> Array:
        """Return a copy of the rows (k, width) that came since the last call."""
        last = self._page.written
        if last < self.next:
            return np.empty((0, self._page.width))
        rows, gone = self._page.rows(self.next, last)
        self.lost += gone
        self.next = last
        return rows


def _anonymous(size: int) -> int:
    """Return the descriptor of zeroed memory that no name leads to."""
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create("gapbridge", os.MFD_CLOEXEC)
    else:
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    os.ftruncate(fd, size)
    return fd
