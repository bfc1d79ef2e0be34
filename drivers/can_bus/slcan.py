"""A serial adapter's port read in pieces: python-can's slcan reads it byte by byte.

A byte costs a select and a read there, a frame some 300 us: an arm that sends 2,800 frames a second
takes a whole core, and what piles up is never caught up with.
"""

from __future__ import annotations

from typing import Any

from can.interfaces.slcan import slcanBus

PIECE = 4096  # bytes read at once, at most


class BufferedPort:
    """A pyserial port whose bytes are fetched in pieces and handed on one by one."""

    def __init__(self, port: Any) -> None:
        self._port = port
        self._piece, self._next = b"", 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._port, name)

    @property
    def write_timeout(self) -> float | None:
        """Return how long a write may take, s; None: without end."""
        timeout: float | None = self._port.write_timeout
        return timeout

    @write_timeout.setter
    def write_timeout(self, seconds: float | None) -> None:
        self._port.apply_settings({"write_timeout": seconds})

    @property
    def in_waiting(self) -> int:
        """Return how many bytes can be read at once. Raises OSError where the port has gone."""
        unread = len(self._piece) - self._next
        return unread if unread else int(self._port.in_waiting)

    def read(self, size: int = 1) -> bytes:
        """Return up to ``size`` bytes, none where none come within the port's timeout."""
        if self._next >= len(self._piece):
            self._piece = self._port.read(min(max(self._port.in_waiting, size), PIECE))
            self._next = 0
        data = self._piece[self._next : self._next + size]
        self._next += len(data)
        return data

    def reset_input_buffer(self) -> None:
        """Drop unread input."""
        self._piece, self._next = b"", 0
        self._port.reset_input_buffer()


class SlcanBus(slcanBus):
    """python-can's bus on a serial adapter, whose port is read in pieces."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.serialPortOrig: Any = BufferedPort(self.serialPortOrig)
