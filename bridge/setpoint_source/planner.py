"""Setpoints from a planner on this machine over a Unix socket: one line per setpoint.

A line is JSON, ``{"q": [..n..]}``, or n comma-separated numbers, rad. The newest line counts. If a
planner is slower than the loop, joints are interpolated over the time between two lines.

Writing here moves the arm, so there is no second attempt: a line that is not a setpoint, or more
lines than the robot has cycles, is answered with ``error: ...`` and ends the connection. What
arrives while the loop is busy arming is dropped unread. From its first valid line on a connection
is the only source, until it closes, or until it has been silent for the timeout and another planner
sends a valid line. In a motion, that line must be near the arm, as the first one of a motion.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import socket
from typing import ClassVar

import numpy as np

from gapbridge.bridge.ipc.control_socket import peer_of, remove_unused
from gapbridge.bridge.setpoint_source.interpolator import InterpolatedSource
from gapbridge.bridge.setpoint_source.source import SourceContext
from gapbridge.core.arrays import Array
from gapbridge.core.errors import RunError
from gapbridge.drivers.clock import Clock

LONGEST_LINE = 4096  # bytes
MOST_BYTES = 16384  # read in one cycle
MOST_LINES = 8  # read in one cycle; the rest is read in the next ones
MOST_WAITING = 4  # connections without a valid line yet
MOST_SKIPPED = 1 << 20  # bytes dropped at once, more than a socket stores
SPAN = 2.0  # s over which lines are counted against the robot's cycles
CLOCK_RATIO = 1.02  # largest ratio of the controller's clock rate, a planner's clock, to this one's


class Connection:
    """One planner's connection: its unread bytes and how many lines it may still send."""

    def __init__(self, link: socket.socket, rate: float, clock: Clock) -> None:
        self._now = clock.monotonic
        link.setblocking(False)
        self._link, self._rate = link, rate
        self._buffer = b""
        self._credit = SPAN * rate
        self._credit_time = self.opened = self._now()
        self.received = 0.0  # s, monotonic: of the last valid line
        self.admitted = False  # the token was sent, or none is needed
        self.closed = False

    def admit(self) -> None:
        """Record that the token was sent, or none is needed."""
        self.admitted = True

    def note_line(self) -> None:
        """Record the time of a valid line."""
        self.received = self._now()

    def lines(self) -> list[bytes]:
        """Return up to MOST_LINES lines that have arrived; closes after too long a line."""
        if b"\n" not in self._buffer:
            self._read()
        *lines, remainder = self._buffer.split(b"\n", MOST_LINES)
        self._buffer = remainder
        if len(remainder.split(b"\n", 1)[0]) > LONGEST_LINE:
            self.refuse("a line without end")
            return []
        now = self._now()
        earned = CLOCK_RATIO * (now - self._credit_time) * self._rate
        self._credit = min(self._credit + earned, SPAN * self._rate)
        self._credit -= len(lines)
        self._credit_time = now
        if self._credit < 0.0:
            self.refuse(f"found more than {self._rate:g} lines per second, the robot's rate")
            return []
        return lines

    def skip(self) -> None:
        """Drop the complete lines that have arrived, except the token; they are not counted."""
        for _ in range(MOST_SKIPPED // MOST_BYTES):
            before = len(self._buffer)
            self._read()
            if self.closed or len(self._buffer) == before:
                break
        *lines, remainder = self._buffer.split(b"\n")
        kept = [] if self.admitted else lines[:1]
        self._buffer = b"\n".join([*kept, remainder])
        self._credit = SPAN * self._rate
        self._credit_time = self.opened = self._now()

    def _read(self) -> None:
        try:
            data = self._link.recv(MOST_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.close()
        self._buffer += data

    def refuse(self, message: str) -> None:
        """Send an error message, and close."""
        with contextlib.suppress(OSError):
            self._link.send(f"error: {message}\n".encode())
        self.close()

    def close(self) -> None:
        """Close; may be repeated."""
        self.closed = True
        self._buffer = b""
        self._link.close()


class PlannerSource(InterpolatedSource):
    """Listens for one planner at a time on a Unix socket of mode 0600. Never blocks.

    A second planner is refused with a line as long as the first one sends.
    """

    expected = "line"
    needs_token: ClassVar[bool] = False

    def __init__(self, context: SourceContext) -> None:
        super().__init__(context)
        self._listener: socket.socket | None = None
        self._planner: Connection | None = None
        self._waiting: list[Connection] = []
        self.refused = 0  # connections ended because of their data

    def open(self) -> None:
        """Listen. Raises RunError where that is not possible."""
        try:
            listener = self._listen()
        except OSError as error:
            raise RunError(
                f"setpoints: cannot listen on {self.where}: {error.strerror or error}"
            ) from None
        listener.listen(MOST_WAITING)
        listener.setblocking(False)
        self._listener = listener

    @property
    def where(self) -> str:
        """Return the address that it listens on, for messages."""
        return str(self.settings.socket)

    def _listen(self) -> socket.socket:
        """Return a bound socket. Raises OSError."""
        path = self.settings.socket
        if path is None:
            raise OSError("no path, expected setpoints.socket")
        remove_unused(path)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        mask = os.umask(0o177)  # no other user can connect before a chmod
        try:
            listener.bind(str(path))
        except OSError:
            listener.close()
            raise
        finally:
            os.umask(mask)
        return listener

    def _may_connect(self, link: socket.socket) -> bool:
        """Return whether the peer is the daemon's user or root, as the kernel reports."""
        return peer_of(link).uid in (0, os.geteuid())

    def _admit(self, connection: Connection, line: bytes) -> bool:
        """Admit a connection by its first line; returns whether the line was a token."""
        return False

    def close(self) -> None:
        """Close planner and listener, and remove the socket."""
        for connection in (self._planner, *self._waiting):
            if connection is not None:
                connection.close()
        self._planner, self._waiting = None, []
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.close()
            self._remove_socket()

    def _remove_socket(self) -> None:
        if self.settings.socket is not None:
            with contextlib.suppress(OSError):
                self.settings.socket.unlink()

    def _receive(self) -> bool:
        """Read what has arrived; returns whether there is a new setpoint."""
        self._accept()
        new = self._planner is not None and self._read(self._planner)
        for connection in tuple(self._waiting):
            new |= self._read(connection)
        if self._planner is not None and self._planner.closed:
            self._planner = None
        self._waiting = [c for c in self._waiting if not c.closed and c is not self._planner]
        return new

    def discard(self) -> None:
        """Drop the lines of all connections; see Source.discard."""
        for _ in range(MOST_WAITING):
            self._accept()
        for connection in (self._planner, *self._waiting):
            if connection is not None:
                connection.skip()
        self._interpolator.forget()

    @property
    def _is_held(self) -> bool:
        """Return whether a planner is active, which another one must not replace."""
        planner = self._planner
        if planner is None or planner.closed:
            return False
        return self._clock.monotonic() - planner.received <= self.settings.timeout

    def _accept(self) -> None:
        if self._listener is None:
            return
        try:
            link, _ = self._listener.accept()
        except OSError:
            return
        connection = Connection(link, self.rate, self._clock)
        if not self.needs_token:
            connection.admit()
        if not self._may_connect(link):
            self._end(connection, "another user's process, expected one of the daemon's own user")
        elif self._is_held:
            connection.refuse("another planner is connected")
        else:
            self._waiting.append(connection)
            if len(self._waiting) > MOST_WAITING:
                self._waiting.pop(0).refuse("too many connections without a setpoint")

    def _read(self, connection: Connection) -> bool:
        """Read the lines of a connection; returns whether one of them is a new setpoint."""
        new = False
        for line in connection.lines():
            text = line.strip()
            if not text:
                continue
            if not connection.admitted and self._admit(connection, text):
                continue
            if not connection.closed:
                new |= self._take(connection, text)
            if connection.closed:
                break
        return new

    def _take(self, connection: Connection, text: bytes) -> bool:
        try:
            values = _numbers(text)
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            shown = text[:60].decode("utf-8", "replace")
            self._end(connection, f'found {shown!r}, expected {{"q": [...]}}')
            return False
        if len(values) != self.n or not all(map(math.isfinite, values)):
            message = f"found {len(values)} numbers, expected {self.n} finite ones, rad"
            self._end(connection, message)
            return False
        q, anew = np.array(values), connection is not self._planner
        if anew and not self._takes_over(connection, q):
            return False
        connection.note_line()
        self._interpolator.take(q, anew)
        return True

    def _takes_over(self, connection: Connection, q: Array) -> bool:
        """Make a connection the planner with its first setpoint (n,) rad, or refuse it.

        In a motion it begins near where the one before it has sent the arm: there is no lead-in.
        """
        if self._is_held:
            connection.refuse("another planner is connected")
            return False
        goal, tolerance = self._interpolator.goal, self.settings.start_tolerance
        away = 0.0 if goal is None else float(np.abs(q - goal).max())
        if away > tolerance:
            self._end(
                connection,
                f"found a first setpoint {away:.4f} rad from the one that the arm goes to, "
                f"expected at most {tolerance:g} (setpoints.start_tolerance)",
            )
            return False
        if self._planner is not None:
            self._planner.refuse("silent, and another planner has taken the feed")
        self._planner = connection
        return True

    def _end(self, connection: Connection, message: str) -> None:
        self.refused += 1
        connection.refuse(message)


def _numbers(text: bytes) -> list[float]:
    """Return the numbers of a line.

    Raises ValueError, KeyError, TypeError, OverflowError or RecursionError for another text.
    """
    if not text.startswith(b"{"):
        return [float(v) for v in text.split(b",")]
    numbers = json.loads(text)["q"]
    # float() takes booleans too, and a text is a sequence of digits
    if not isinstance(numbers, list) or any(type(v) not in (int, float) for v in numbers):
        raise TypeError("found another value than a number")
    return [float(v) for v in numbers]
