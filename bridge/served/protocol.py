"""HTTP connections with time limits for slow clients, and a limit of their number."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

HEADER_TIME = 5.0  # s for a request's head, from its first byte or the connection
STALL_TIME = 10.0  # s that a client may not read what was sent to it
MOST_CONNECTIONS = 64
LARGEST_HEAD = 16 * 1024  # bytes of request line and headers


class GuardedProtocol(H11Protocol):
    """The server's own protocol, with the time limits that it lacks.

    The base class waits without limit for the end of a request (slowloris) and for a client that
    does not read; here both are cut off, and connections beyond MOST_CONNECTIONS are closed.
    """

    header_time = HEADER_TIME
    stall_time = STALL_TIME
    most_connections = MOST_CONNECTIONS

    def __init__(self, *arguments: Any, **keys: Any) -> None:
        super().__init__(*arguments, **keys)
        self._waiting_for_head: asyncio.TimerHandle | None = None
        self._stalled: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection, unless there are too many."""
        super().connection_made(transport)
        if len(self.connections) > self.most_connections:
            transport.abort()
            return
        self._waiting_for_head = self.loop.call_later(self.header_time, transport.abort)

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timers."""
        self._cancel_head_timer()
        self._cancel_stall_timer()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Read bytes; the timer of an incomplete head goes on."""
        super().data_received(data)
        if self.transport.is_closing():
            return
        if self.cycle is not None and not self.cycle.response_complete:
            self._cancel_head_timer()
        elif self._waiting_for_head is None:
            self._waiting_for_head = self.loop.call_later(self.header_time, self.transport.abort)

    def on_response_complete(self) -> None:
        """Go on to the next request."""
        super().on_response_complete()
        self._cancel_head_timer()

    def pause_writing(self) -> None:
        """Start the timer of a client that does not read."""
        super().pause_writing()
        if self._stalled is None:
            self._stalled = self.loop.call_later(self.stall_time, self.transport.abort)

    def resume_writing(self) -> None:
        """Stop the timer: the client reads again."""
        self._cancel_stall_timer()
        super().resume_writing()

    def _cancel_head_timer(self) -> None:
        timer, self._waiting_for_head = self._waiting_for_head, None
        if timer is not None:
            timer.cancel()

    def _cancel_stall_timer(self) -> None:
        timer, self._stalled = self._stalled, None
        if timer is not None:
            timer.cancel()
