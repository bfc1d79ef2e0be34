"""Memory that the loop's process writes and all others read: heartbeat, state, counts, cycles.

One writer, words of 8 bytes, and no locks: if one process dies or hangs, the others go on. Cycles
are written to a ring; each row begins with its number, so that a reader detects a row that is
incomplete or overwritten.

A process of the loop maps its memory and seals it (sealed_memory.py): no other process can write.
The next process gets a new memory that starts as a copy, so that cycles and counts continue over
all processes of a run; the daemon and the side processes switch to it (RunMemory, FollowedMemory).
Commands have their own memory (command_memory.py).
"""

from __future__ import annotations

import contextlib
import functools
import os
import socket
from collections.abc import Mapping
from enum import IntEnum

import numpy as np

from gapbridge.bridge.ipc.loop_counters import LoopCounter
from gapbridge.bridge.ipc.sealed_memory import (
    is_sealed,
    make_memory,
    map_as_reader,
    map_as_writer,
    seal,
)
from gapbridge.core.arrays import Array
from gapbridge.core.state import RobotState
from gapbridge.drivers.clock import Clock

WORDS = 128
ROWS = 8192  # cycles kept: 16 s at 500 Hz
NAME = "gapbridge-cycles"  # of the memory, as /proc shows it
# words; the heartbeat's time is a float in a word of its own
_BEATS, _PHASE, _STATE, _TAKEN, _WRITTEN, _ENDED, _SEEN = range(7)
_BEAT_TIME = 32
_COUNTS = 64  # from here on one word for each counter, over all processes of the loop
OPTIONAL = ("ft_raw_wrench", "joint_temperatures", "actual_current_as_torque", "payload_cog")
"""Fields of a state that not every controller has."""


class Phase(IntEnum):
    """The phase of the loop's process; each has its own limit without a heartbeat."""

    STARTING = 0  # imports, compilation
    CONNECTING = 1  # constructors of the robot's library, which can hang
    RUNNING = 2
    ARMING = 3
    ENDING = 4


@functools.cache
def slices_of(n: int) -> dict[str, slice]:
    """Return the slice of each field in a cycle's row: 1, n, 3 or 6 numbers, n joints."""
    slices, start = {}, 0
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
        slices[name] = slice(start, start + size)
        start += size
    return slices


def write_cycle(
    row: Array,
    slices: Mapping[str, slice],
    state: RobotState,
    nominal_q: Array,
    corrected_q: Array,
    offset_in_base: Array,
) -> None:
    """Write a state and its setpoint into ``row``; NaN where the controller lacks a field."""
    row[1] = state.timestamp
    row[slices["target_q"]] = state.target_q
    row[slices["actual_q"]] = state.actual_q
    row[slices["actual_qd"]] = state.actual_qd
    row[slices["actual_TCP_force"]] = state.actual_TCP_force
    row[slices["payload"]] = np.nan if state.payload is None else state.payload
    for name in OPTIONAL:
        value = getattr(state, name)
        row[slices[name]] = np.nan if value is None else value
    row[slices["nominal_q"]] = nominal_q
    row[slices["corrected_q"]] = corrected_q
    row[slices["offset"]] = offset_in_base
    start = slices["received"].start
    row[start] = state.received
    start = slices["robot_mode"].start
    row[start : start + 5] = (
        state.robot_mode, state.safety_mode, state.runtime_state, state.safety_status_bits,
        state.speed_scaling,
    )  # fmt: skip


class SharedMemory:
    """The shared memory, as any side reads it.

    Without ``fd`` it is created; with one it is mapped, for reading only unless ``writable``.
    Mapping it for writing seals it.
    """

    def __init__(
        self, n: int, fd: int | None = None, writable: bool = True, *, clock: Clock
    ) -> None:
        self._now = clock.monotonic
        self.n = n
        self.slices = slices_of(n)
        self.width = max(part.stop for part in self.slices.values())
        self._size = 8 * (WORDS + ROWS * self.width)
        self._attach(make_memory(NAME, self._size) if fd is None else fd, writable)

    def _attach(self, fd: int, writable: bool) -> None:
        """Map this memory from now on; arrays of the former mapping stay valid."""
        self._map = (map_as_writer if writable else map_as_reader)(fd, self._size)
        self.fd = fd
        self._words = np.frombuffer(self._map, np.int64, WORDS)
        self._times = np.frombuffer(self._map, np.float64, WORDS)
        rows = np.frombuffer(self._map, np.float64, ROWS * self.width, 8 * WORDS)
        self._rows = rows.reshape(ROWS, self.width)

    # -- the loop's side --------------------------------------------------------------------------

    def beat(self) -> None:
        """Report that the loop is alive."""
        self._times[_BEAT_TIME] = self._now()
        self._words[_BEATS] += 1

    def enter(self, phase: Phase) -> None:
        """Report the phase that begins."""
        self.beat()
        self._words[_PHASE] = phase

    def note_state(self, state: int) -> None:
        """Report the supervisor's state."""
        self._words[_STATE] = state

    def note_ended(self) -> None:
        """Report that the source has come to its end."""
        self._words[_ENDED] = 1

    def note_state_read(self) -> None:
        """Report that a state has been read."""
        self._words[_SEEN] = 1

    def count(self, what: LoopCounter, times: int = 1) -> None:
        """Count an event."""
        self._words[_COUNTS + what] += times

    def next_row(self) -> Array:
        """Return the row of the next cycle; fill it from column 1 on, then call ``publish``."""
        row: Array = self._rows[self._words[_WRITTEN] % ROWS]
        row[0] = -1.0
        return row

    def publish(self) -> None:
        """Make the filled row visible to readers."""
        written = int(self._words[_WRITTEN])
        self._rows[written % ROWS, 0] = written
        self._words[_WRITTEN] = written + 1

    def note_taken(self, number: int) -> None:
        """Report the number of the newest request received; see command_memory.py."""
        self._words[_TAKEN] = number

    # -- the readers' side ------------------------------------------------------------------------

    def follow(self) -> None:
        """Switch to the memory of the newest process of the loop."""

    def open_for_reading(self) -> int:
        """Return a new read-only descriptor of the memory, to be closed by the caller."""
        return _read_only(self.fd)

    @property
    def last_taken(self) -> int:
        """Return the number of the newest request that the loop has received."""
        return int(self._words[_TAKEN])

    @property
    def phase(self) -> Phase:
        """Return the phase of the loop's process."""
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
    def has_state(self) -> bool:
        """Return whether a state has been read."""
        return bool(self._words[_SEEN])

    @property
    def silence(self) -> float:
        """Return s since the last heartbeat; 0 before the first."""
        beat = float(self._times[_BEAT_TIME])
        return self._now() - beat if beat else 0.0

    @property
    def written(self) -> int:
        """Return how many cycles have been published since the daemon's start."""
        return int(self._words[_WRITTEN])

    def counts(self) -> dict[str, int]:
        """Return how often each LoopCounter has happened since the daemon's start."""
        return {what.label: int(self._words[_COUNTS + what]) for what in LoopCounter}

    def reader(self, first: int = 0) -> CycleReader:
        """Return a reader that begins at row number ``first``."""
        return CycleReader(self, first)

    def rows(self, first: int, last: int) -> tuple[Array, int]:
        """Return copies of rows first..last-1 (k, width), and how many were overwritten."""
        oldest = max(first, last - ROWS + ROWS // 8)  # older rows may be overwritten now
        index = np.arange(oldest, last)
        places = index % ROWS
        rows = self._rows.take(places, 0)
        whole = (rows[:, 0] == index) & (self._rows[places, 0] == index)
        return rows[whole], oldest - first + int(np.count_nonzero(~whole))

    def close(self) -> None:
        """Unmap and close the memory."""
        self._words = self._times = np.empty(0)  # type: ignore[assignment]
        self._rows = np.empty((0, 0))
        self._map.close()
        os.close(self.fd)


class RunMemory(SharedMemory):
    """The daemon's read-only view of one loop after the other; cycles and counts continue."""

    def __init__(self, n: int, clock: Clock) -> None:
        super().__init__(n, writable=False, clock=clock)
        seal(self.fd)  # initial memory, before the first loop
        self._shown = os.dup(self.fd)  # the newest one that is sealed
        self._is_shown = True

    def renew(self) -> None:
        """Create the memory of a new process of the loop as a copy; the last one has ended.

        Raises OSError; then the one before stays.
        """
        fd = make_memory(NAME, self._size)
        head = self._words.copy()
        head[[_BEATS, _PHASE, _STATE, _ENDED, _SEEN]] = 0
        head[_BEAT_TIME] = 0
        before = self.fd
        try:
            os.pwrite(fd, head.tobytes(), 0)
            if self.written:
                _write_whole(fd, self._rows[: self.written], head.nbytes)
            self._attach(fd, writable=False)  # before closing: other threads are reading
        except OSError:
            os.close(fd)
            raise
        self._is_shown = False
        os.close(before)

    def promote(self) -> bool:
        """Show the memory to readers once its loop has sealed it; returns whether it has."""
        if self._is_shown or not is_sealed(self.fd):
            return False
        # in one step: the number is never another file's, whoever opens it and wherever this ends
        os.dup2(self.fd, self._shown, inheritable=False)
        self._is_shown = True
        return True

    def open_for_reading(self) -> int:
        """Return a read-only descriptor of the newest sealed memory, to be closed by the caller."""
        return _read_only(self._shown)

    def close(self) -> None:
        """Unmap and close the memory."""
        super().close()
        os.close(self._shown)


class FollowedMemory(SharedMemory):
    """A side process's view: it switches to each memory that the daemon sends."""

    def __init__(self, n: int, fd: int, successors: socket.socket, clock: Clock) -> None:
        super().__init__(n, fd, writable=False, clock=clock)
        self._successors = successors
        successors.setblocking(False)

    def follow(self) -> None:
        """Switch to the newest memory received."""
        with contextlib.suppress(OSError):
            while True:
                data, fds, _, _ = socket.recv_fds(self._successors, 1, 4)
                if not data:  # the daemon is gone
                    return
                for fd in fds:
                    before = self.fd
                    self._attach(fd, writable=False)
                    os.close(before)


class CycleReader:
    """One reader of the cycles; any number may read concurrently."""

    def __init__(self, memory: SharedMemory, first: int) -> None:
        self._memory = memory
        self.next = first  # number of the first row that it has not read
        self.lost = 0  # rows overwritten before they were read

    def drain(self) -> Array:
        """Return a copy of the rows (k, width) that came since the last call."""
        self._memory.follow()
        last = self._memory.written
        if last < self.next:
            return np.empty((0, self._memory.width))
        rows, gone = self._memory.rows(self.next, last)
        self.lost += gone
        self.next = last
        return rows

    def take_lost(self) -> int:
        """Return how many rows were lost since the last call."""
        lost, self.lost = self.lost, 0
        return lost


def _read_only(fd: int) -> int:
    path = f"/proc/self/fd/{fd}"
    return os.open(path, os.O_RDONLY) if os.path.exists(path) else os.dup(fd)


def _write_whole(fd: int, rows: Array, offset: int) -> None:
    data = memoryview(rows.tobytes())
    while data:
        done = os.pwrite(fd, data, offset)
        data, offset = data[done:], offset + done
