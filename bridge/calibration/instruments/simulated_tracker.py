"""The laser tracker beside `gapbridge simulate`: its bench port."""

from __future__ import annotations

import socket

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import Instrument, Samples, Where
from gapbridge.bridge.cell.settings.instruments import SimulatedTrackerSettings
from gapbridge.core.errors import LinkError

PERIOD_LIMIT = 5.0  # s


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
        try:
            self._socket = socket.create_connection(address, timeout=PERIOD_LIMIT)
        except OSError as error:
            raise LinkError(
                f"simulated tracker at {address[0]}:{address[1]}: {error.strerror or error}; "
                "expected `gapbridge simulate` to serve the cell"
            ) from None

    def read(self, where: Where) -> Samples:
        """Return samples (M, 3) or (M, 6). Raises LinkError."""
        samples = [self._measure() for _ in range(where.samples)]
        found = np.array(samples)[:, 1:]
        return Samples(found if self.settings.pose else found[:, :3])

    def _measure(self) -> list[float]:
        assert self._socket is not None
        try:
            self._socket.sendall(b"measure\n")
            while b"\n" not in self._buffer:
                data = self._socket.recv(4096)
                if not data:
                    raise ConnectionError("it has hung up")
                self._buffer += data
        except OSError as error:
            raise LinkError(f"{self.name}: {error}") from None
        line, _, self._buffer = self._buffer.partition(b"\n")
        return [float(v) for v in line.split(b",")]

    def close(self) -> None:
        """Hang up."""
        found, self._socket = self._socket, None
        if found is not None:
            found.close()
