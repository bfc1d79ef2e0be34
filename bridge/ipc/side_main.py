"""A side process's part: its start data, the shared memory, the daemon's events.

Recorder, status page and metrics are side processes: they only read and cannot delay the loop. The
daemon starts them (side_process.py). Their module begins with ``read_start_data()`` and ends when
``start.events.closed`` shows that the daemon has ended.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.ipc.shared_memory import FollowedMemory, SharedMemory
from gapbridge.core.errors import GapbridgeError
from gapbridge.drivers.clock import SYSTEM, Clock

END_TIMEOUT = 5.0  # s that a side process may take to end after the daemon
NICENESS = 5  # the loop comes first
_PIECE = 1 << 16


class EventLines:
    """Reads the daemon's events from a pipe, one JSON object a line."""

    def __init__(self, fd: int) -> None:
        self.fd = fd  # for select and event loops
        os.set_blocking(fd, False)
        self._buffer = b""
        self.closed = False  # the daemon has ended: finish and end

    def poll(self) -> list[dict[str, Any]]:
        """Return the events that have arrived; never blocks."""
        while not self.closed:
            try:
                data = os.read(self.fd, _PIECE)
            except BlockingIOError:
                break
            self.closed = not data
            self._buffer += data
        *lines, self._buffer = self._buffer.split(b"\n")
        return [event for event in map(read_event, lines) if event is not None]

    def wait(self, timeout: float) -> None:
        """Sleep until something arrives, the daemon has ended, or ``timeout`` s are over."""
        if not self.closed:
            select.select([self.fd], [], [], timeout)

    def close(self) -> None:
        """Close the pipe."""
        os.close(self.fd)
        self.closed = True


class EventWriter:
    """Writes events to a pipe, one JSON object a line; never blocks, never writes half a line."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        os.set_blocking(fd, False)
        self._buffer = b""
        self.sent = 0
        self.dropped = 0  # events dropped because the pipe was full

    def emit(self, event: dict[str, Any]) -> bool:
        """Write an event; returns False if the pipe is full or closed."""
        self._flush()
        if self._buffer:
            self.dropped += 1
            return False
        self._buffer = (json.dumps(event, default=str) + "\n").encode()
        whole = len(self._buffer)
        self._flush()
        if len(self._buffer) == whole:  # nothing was written: drop it
            self._buffer = b""
            self.dropped += 1
            return False
        self.sent += 1
        return True

    def take_dropped(self) -> int:
        """Return how many events were dropped, once."""
        dropped, self.dropped = self.dropped, 0
        return dropped

    def _flush(self) -> None:
        """Write the rest of a partly written event."""
        with contextlib.suppress(OSError):
            while self._buffer:
                self._buffer = self._buffer[os.write(self._fd, self._buffer) :]


@dataclass(frozen=True)
class StartData:
    """The data that the daemon passes to a side process at its start."""

    settings: DaemonSettings
    n: int  # joints
    session: str  # name of the daemon's run, run-YYYYmmdd-HHMMSS
    memory: SharedMemory  # for reading only
    events: EventLines
    up: EventWriter
    extra: dict[str, Any]
    clock: Clock

    def emit(self, event: dict[str, Any]) -> None:
        """Send the daemon an event (a dict with "kind"), which it distributes; never blocks."""
        now = {"time": self.clock.time(), "monotonic": self.clock.monotonic()}
        self.up.emit({**now, **event})


def read_start_data() -> StartData:
    """Return the start data, which the daemon has passed as stdin."""
    start_data = json.loads(sys.stdin.readline())
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    events = EventLines(start_data["events"])
    threading.Thread(target=_end_after_daemon, args=(events.fd, SYSTEM), daemon=True).start()
    return StartData(
        settings=DaemonSettings.model_validate(start_data["settings"]),
        n=start_data["n"],
        session=start_data["session"],
        memory=FollowedMemory(
            start_data["n"],
            start_data["memory"],
            socket.socket(fileno=start_data["successors"]),
            SYSTEM,
        ),
        events=events,
        up=EventWriter(start_data["up"]),
        extra=start_data.get("extra", {}),
        clock=SYSTEM,
    )


def run_side(kind: str, run: Callable[[StartData], None]) -> int:
    """Run a side process until the daemon has ended; returns the exit code."""
    start = read_start_data()
    try:
        run(start)
    except GapbridgeError as error:
        start.emit({"kind": kind, "failure": str(error)})
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def read_event(line: bytes) -> dict[str, Any] | None:
    """Return the event of a line; None if it is not one."""
    try:
        event = json.loads(line)
    except ValueError:
        return None
    return event if isinstance(event, dict) else None


def _end_after_daemon(fd: int, clock: Clock) -> None:
    """End this process END_TIMEOUT s after the daemon has closed the pipe, even if it hangs."""
    watch = select.poll()
    watch.register(fd, 0)  # hang-ups only, which are always reported
    watch.poll()
    clock.sleep(END_TIMEOUT)
    os._exit(1)
