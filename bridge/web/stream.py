"""Server-sent events to every page that is open; one that does not keep up is let go."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable

WAITING = 100  # messages that a page may be behind
RETRY = 1000  # ms after which a browser tries again
COMMENT = 5.0  # s without a message after which a sign of life is sent


class Stream:
    """One hub: ``publish`` puts a message into every subscriber's queue and never waits."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._queues: set[asyncio.Queue[str | None]] = set()
        self.cut_off = 0  # pages that did not keep up

    @property
    def full(self) -> bool:
        """Return whether as many pages are open as may be."""
        return len(self._queues) >= self._most

    @property
    def is_watched(self) -> bool:
        """Return whether any page is open."""
        return bool(self._queues)

    def publish(self, kind: str, data: str) -> None:
        """Send one message (JSON text) to all."""
        text = message(kind, data)
        for queue in list(self._queues):
            try:
                queue.put_nowait(text)
            except asyncio.QueueFull:
                self._queues.discard(queue)
                self.cut_off += 1
                queue.get_nowait()
                queue.put_nowait(None)  # its end

    def close(self) -> None:
        """End all streams."""
        for queue in list(self._queues):
            self._queues.discard(queue)
            if queue.full():
                queue.get_nowait()
            queue.put_nowait(None)

    async def subscribe(self, first: Callable[[], str]) -> AsyncIterator[str]:
        """Give the text of ``first()``, then every message, until the stream ends."""
        queue: asyncio.Queue[str | None] = asyncio.Queue(WAITING)
        self._queues.add(queue)
        try:
            yield f"retry: {RETRY}\n{first()}"
            while True:
                try:
                    text = await asyncio.wait_for(queue.get(), COMMENT)
                except TimeoutError:
                    text = ":\n\n"
                if text is None:
                    return
                yield text
        finally:
            self._queues.discard(queue)


def message(kind: str, data: str) -> str:
    """Return one server-sent event; ``data`` is JSON, so in one line."""
    return f"event: {kind}\ndata: {data}\n\n"
