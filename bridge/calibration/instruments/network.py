"""Instruments connected by a TCP socket, one reading per line: tracker software, or simulated."""

from __future__ import annotations

import contextlib
import socket
import time

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    ReadRequest,
    Samples,
)
from gapbridge.bridge.calibration.instruments.numbers import parse_numbers, to_si
from gapbridge.bridge.cell.settings.instruments import LineFeedSettings, SimulatedTrackerSettings
from gapbridge.core.calibration.plan import Payload
from gapbridge.core.errors import LinkError

LONGEST_LINE = 4096  # bytes
CONNECT_TIMEOUT = 5.0  # s
SCRIPT_PORT = 30003  # of a UR controller


def _connect_to(who: str, address: tuple[str, int], expected: str) -> socket.socket:
    """Return a connection. Raises LinkError naming ``who`` did not answer."""
    try:
        return socket.create_connection(address, timeout=CONNECT_TIMEOUT)
    except OSError as error:
        raise LinkError(
            f"{who} {address[0]}:{address[1]}: {error.strerror or error}; expected {expected}"
        ) from None


class LineFeed(Instrument[LineFeedSettings]):
    """Opens a new connection for each reading: no buffered line of an earlier pose is used."""

    @property
    def name(self) -> str:
        """Return the address."""
        return f"lines from {self.settings.host}:{self.settings.port} in {self.settings.unit}"

    def open(self) -> None:
        """Check that a connection is accepted. Raises LinkError."""
        self._connect().close()

    def _connect(self) -> socket.socket:
        return _connect_to(
            "calibration.instrument", (self.settings.host, self.settings.port),
            "the tracker's software to listen there",
        )  # fmt: skip

    def read(self, request: ReadRequest) -> Samples:
        """Return ``request.samples`` samples (M, 3) or (M, 6). Raises ReadingError, LinkError."""
        settings, values, buffer = self.settings, [], b""
        with self._connect() as link:
            for _ in range(request.samples):
                if settings.trigger:
                    link.sendall(settings.trigger.encode() + b"\n")
                line, buffer = self._line(link, buffer)
                values.append(to_si(parse_numbers(line, settings.width, *settings.units), settings))
        return Samples(np.array(values))

    def _line(self, link: socket.socket, buffer: bytes) -> tuple[str, bytes]:
        """Return the next line that is not empty, and the bytes received after it."""
        settings, until = self.settings, time.monotonic() + self.settings.timeout
        while True:
            line, end, after = buffer.partition(b"\n")
            if end and line.strip():
                return line.decode("utf-8", "replace"), after
            buffer = after if end else buffer
            if end:
                continue
            remaining = until - time.monotonic()
            if remaining <= 0.0:
                raise ReadingError(f"found no line for {settings.timeout:g} s, expected a reading")
            link.settimeout(remaining)
            try:
                data = link.recv(LONGEST_LINE)
            except TimeoutError:
                continue
            except OSError as error:
                raise LinkError(f"{self.name}: {error}") from None
            if not data:
                raise LinkError(f"{self.name}: the connection was closed")
            buffer += data
            if len(buffer) > LONGEST_LINE and b"\n" not in buffer:
                raise ReadingError(f"found {len(buffer)} bytes without the end of a line")


class SimulatedTracker(Instrument[SimulatedTrackerSettings]):
    """Takes samples from the simulated tracker of `gapbridge simulate` at its bench port."""

    def __init__(self, *settings: object) -> None:
        super().__init__(*settings)  # type: ignore[arg-type]
        self._socket: socket.socket | None = None
        self._buffer = b""

    @property
    def name(self) -> str:
        """Return its address."""
        return f"simulated tracker at {self._host}"

    @property
    def _host(self) -> str:
        return self.settings.host or self.context.link_host or "127.0.0.2"

    def open(self) -> None:
        """Connect to the bench. Raises LinkError."""
        address = (self._host, self.settings.port)
        expected = "`gapbridge simulate` to serve the cell"
        self._socket = _connect_to("simulated tracker at", address, expected)

    def read(self, request: ReadRequest) -> Samples:
        """Return samples (M, 3) m, or (M, 6) m and rotation vector. Raises LinkError."""
        samples = [self._measure() for _ in range(request.samples)]
        values = np.array(samples)[:, 1:]
        return Samples(values if self.settings.pose else values[:, :3])

    def set_load(self, load: Payload) -> None:
        """Mount the load on the simulated flange, and set it in a UR controller.

        Raises LinkError.
        """
        values = [f"{v:.9g}" for v in (load.mass, *load.cog)]
        answer = self._answer("payload " + " ".join(values))
        if answer.startswith("error"):
            raise LinkError(f"{self.name}: load: {answer}")
        program = f"def hang():\n  set_payload({values[0]}, [{', '.join(values[1:])}])\nend\n"
        with (
            contextlib.suppress(ConnectionError),  # other controllers have no such port
            socket.create_connection((self._host, SCRIPT_PORT), CONNECT_TIMEOUT) as script,
        ):
            script.sendall(program.encode())

    def _measure(self) -> list[float]:
        return [float(v) for v in self._answer("measure").split(",")]

    def _answer(self, line: str) -> str:
        """Return the bench's answer to a line. Raises LinkError."""
        assert self._socket is not None
        try:
            self._socket.sendall(line.encode() + b"\n")
            while b"\n" not in self._buffer:
                data = self._socket.recv(4096)
                if not data:
                    raise ConnectionError("the connection was closed")
                self._buffer += data
        except OSError as error:
            raise LinkError(f"{self.name}: {error}") from None
        answer, _, self._buffer = self._buffer.partition(b"\n")
        return answer.decode()

    def close(self) -> None:
        """Close the connection."""
        connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()
