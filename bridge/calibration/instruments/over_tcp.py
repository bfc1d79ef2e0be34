"""Instruments that answer over TCP, a reading a line: a tracker's software, or a simulated one."""

from __future__ import annotations

import contextlib
import socket
import time

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    Samples,
    Where,
)
from gapbridge.bridge.calibration.instruments.numbers import coordinates, numbers
from gapbridge.bridge.cell.settings.instruments import LineFeedSettings, SimulatedTrackerSettings
from gapbridge.core.calibration.plan import Payload
from gapbridge.core.errors import LinkError

LONGEST_LINE = 4096  # bytes
CONNECTING = 5.0  # s
SCRIPT_PORT = 30003  # of a UR controller


def _connected(who: str, address: tuple[str, int], expected: str) -> socket.socket:
    """Return a connection. Raises LinkError, which names who did not answer."""
    try:
        return socket.create_connection(address, timeout=CONNECTING)
    except OSError as error:
        raise LinkError(
            f"{who} {address[0]}:{address[1]}: {error.strerror or error}; expected {expected}"
        ) from None


class LineFeed(Instrument[LineFeedSettings]):
    """Connects anew for each pose, so that no line is older than the pose."""

    @property
    def name(self) -> str:
        """Return the address."""
        return f"lines from {self.settings.host}:{self.settings.port} in {self.settings.unit}"

    def open(self) -> None:
        """Connect once, to see that somebody is there. Raises LinkError."""
        self._connect().close()

    def _connect(self) -> socket.socket:
        return _connected(
            "calibration.instrument", (self.settings.host, self.settings.port),
            "the tracker's software to listen there",
        )  # fmt: skip

    def read(self, where: Where) -> Samples:
        """Return as many samples as are asked for. Raises ReadingError, LinkError."""
        given, found, rest = self.settings, [], b""
        with self._connect() as link:
            for _ in range(where.samples):
                if given.trigger:
                    link.sendall(given.trigger.encode() + b"\n")
                line, rest = self._line(link, rest)
                found.append(coordinates(numbers(line, given.width, given.unit), given))
        return Samples(np.array(found))

    def _line(self, link: socket.socket, rest: bytes) -> tuple[str, bytes]:
        """Return the next line that is not empty, and what came after it."""
        given, until = self.settings, time.monotonic() + self.settings.timeout
        while True:
            line, end, after = rest.partition(b"\n")
            if end and line.strip():
                return line.decode("utf-8", "replace"), after
            rest = after if end else rest
            if end:
                continue
            left = until - time.monotonic()
            if left <= 0.0:
                raise ReadingError(f"found no line within {given.timeout:g} s, expected a reading")
            link.settimeout(left)
            try:
                data = link.recv(LONGEST_LINE)
            except TimeoutError:
                continue
            except OSError as error:
                raise LinkError(f"{self.name}: {error}") from None
            if not data:
                raise LinkError(f"{self.name}: it has hung up")
            rest += data
            if len(rest) > LONGEST_LINE and b"\n" not in rest:
                raise ReadingError(f"found {len(rest)} bytes without the end of a line")


class SimulatedTracker(Instrument[SimulatedTrackerSettings]):
    """Asks the bench to measure, as often as samples are wanted."""

    def __init__(self, *given: object) -> None:
        super().__init__(*given)  # type: ignore[arg-type]
        self._socket: socket.socket | None = None
        self._buffer = b""

    @property
    def name(self) -> str:
        """Return where it is."""
        return f"simulated tracker at {self._host}"

    @property
    def _host(self) -> str:
        return self.settings.host or self.around.link_host or "127.0.0.2"

    def open(self) -> None:
        """Connect to the bench. Raises LinkError."""
        address = (self._host, self.settings.port)
        expected = "`gapbridge simulate` to serve the cell"
        self._socket = _connected("simulated tracker at", address, expected)

    def read(self, where: Where) -> Samples:
        """Return samples (M, 3) or (M, 6). Raises LinkError."""
        samples = [self._measure() for _ in range(where.samples)]
        found = np.array(samples)[:, 1:]
        return Samples(found if self.settings.pose else found[:, :3])

    def hung(self, load: Payload) -> None:
        """Hang the load on the simulated flange, and enter it in a UR controller.

        Raises LinkError.
        """
        numbers = [f"{v:.9g}" for v in (load.mass, *load.cog)]
        answer = self._answer("payload " + " ".join(numbers))
        if answer.startswith("error"):
            raise LinkError(f"{self.name}: load: {answer}")
        program = f"def hang():\n  set_payload({numbers[0]}, [{', '.join(numbers[1:])}])\nend\n"
        with (
            contextlib.suppress(ConnectionError),  # other controllers take no load
            socket.create_connection((self._host, SCRIPT_PORT), CONNECTING) as script,
        ):
            script.sendall(program.encode())

    def _measure(self) -> list[float]:
        return [float(v) for v in self._answer("measure").split(",")]

    def _answer(self, line: str) -> str:
        """Return what the bench answers to a line. Raises LinkError."""
        assert self._socket is not None
        try:
            self._socket.sendall(line.encode() + b"\n")
            while b"\n" not in self._buffer:
                data = self._socket.recv(4096)
                if not data:
                    raise ConnectionError("it has hung up")
                self._buffer += data
        except OSError as error:
            raise LinkError(f"{self.name}: {error}") from None
        answer, _, self._buffer = self._buffer.partition(b"\n")
        return answer.decode()

    def close(self) -> None:
        """Hang up."""
        found, self._socket = self._socket, None
        if found is not None:
            found.close()
