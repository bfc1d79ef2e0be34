"""Setpoints from a planner over TCP on loopback: one line per setpoint.

A line is JSON, ``{"q": [..n..]}``, or n numbers with commas between, rad. The newest line counts.
Where a planner is slower than the loop, joints glide from setpoint to setpoint over the time that
two lines are apart. A bad line is answered with ``error: ...`` and not used.
"""

from __future__ import annotations

import contextlib
import json
import math
import socket
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bridge.cell.sections import SetpointSettings
from bridge.setpoint_source.glide import Glide
from bridge.setpoint_source.source import Source
from core.errors import RunError

Vector = NDArray[np.float64]
LONGEST_LINE = 4096  # bytes
MOST_BYTES = 65536  # read in one cycle


class TcpSource(Source):
    """Listens for one planner at a time; a second one is turned away. Never blocks."""

    def __init__(self, settings: SetpointSettings, n: int, moves_arm: bool, folder: Path) -> None:
        super().__init__(settings, n, moves_arm, folder)
        self._listener: socket.socket | None = None
        self._planner: socket.socket | None = None
        self._buffer = b""
        self._glide = Glide(settings.timeout, "line")
        self.bad_lines = 0

    @property
    def port(self) -> int:
        """Return the port it listens on."""
        return int(self._listener.getsockname()[1]) if self._listener is not None else 0

    def open(self) -> None:
        """Listen. Raises RunError where the address is taken."""
        address = (self.settings.host, self.settings.port)
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(address)
        except OSError as error:
            listener.close()
            raise RunError(
                f"setpoints: cannot listen on {address[0]}:{address[1]}: {error.strerror}"
            ) from None
        listener.listen(4)
        listener.setblocking(False)
        self._listener = listener

    def close(self) -> None:
        """Close planner and listener."""
        for found in (self._planner, self._listener):
            if found is not None:
                found.close()
        self._planner = self._listener = None

    def first(self, own_q: Vector) -> Vector | None:
        """Return the newest setpoint where one has come lately."""
        self._receive()
        return self._glide.first()

    def begin(self, timestamp: float, own_q: Vector) -> None:
        """Start from where the arm stands."""
        self._glide.begin(own_q)

    def sample(self, timestamp: float, own_q: Vector) -> Vector:
        """Return the setpoint of this moment. Raises SourceDryError where no line came in time."""
        if self._receive():
            self._glide.turn()
        return self._glide.sample()

    def _receive(self) -> bool:
        """Take what has arrived; returns whether there is a new setpoint."""
        self._accept()
        planner, new = self._planner, False
        if planner is None:
            return False
        try:
            data = planner.recv(MOST_BYTES)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        if not data:
            planner.close()
            self._planner, self._buffer = None, b""
            return False
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        if len(self._buffer) > LONGEST_LINE:
            self._refuse("a line without end")
            self._buffer = b""
        for line in lines:
            new |= self._take(line)
        return new

    def _accept(self) -> None:
        if self._listener is None:
            return
        try:
            planner, _ = self._listener.accept()
        except OSError:
            return
        planner.setblocking(False)
        if self._planner is not None:
            with contextlib.suppress(OSError):
                planner.send(b"error: another planner is connected\n")
            planner.close()
            return
        planner.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._planner = planner

    def _take(self, line: bytes) -> bool:
        text = line.strip()
        if not text:
            return False
        try:
            found = json.loads(text)["q"] if text.startswith(b"{") else text.split(b",")
            values = [float(v) for v in found]
        except (ValueError, KeyError, TypeError, RecursionError):
            self._refuse(f'found {text[:60].decode("utf-8", "replace")!r}, expected {{"q": [...]}}')
            return False
        if len(values) != self.n or not all(map(math.isfinite, values)):
            self._refuse(f"found {len(values)} numbers, expected {self.n} finite ones, rad")
            return False
        self._glide.take(np.array(values))
        return True

    def _refuse(self, words: str) -> None:
        self.bad_lines += 1
        if self._planner is not None:
            with contextlib.suppress(OSError):
                self._planner.send(f"error: {words}\n".encode())
