"""The tap: keeps what goes over the wire with its time, and hands it on decoded.

Keeping costs next to nothing, so that the wire is not slowed; decoding comes when ``drain`` is
called, in another thread.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from benchmarks.faults.proxy import UP, Port
from benchmarks.faults.splitting import Splitter
from benchmarks.faults.wire.seen import Decoder, Fresh, Write


class Tap:
    """Messages of one link; ``state`` gives the supervisor's state at this moment."""

    def __init__(self, decoder: Decoder, ports: Iterable[Port], state: Callable[[], int]) -> None:
        self.state = state
        self._splitters = {port.name: port.splitter for port in ports}
        self._whole: dict[int, Splitter] = {}  # by connection: what came in pieces
        self._decoder = decoder
        self._kept: deque[tuple[float, float, int, str, bool, bytes, int]] = deque()
        self.messages = 0

    def emit(
        self, earliest: float, time: float, connection: int, port: str, direction: str,
        message: bytes,
    ) -> None:  # fmt: skip
        """Keep a message; called by the proxy."""
        self.messages += 1
        state = self.state()
        self._kept.append((earliest, time, connection, port, direction == UP, message, state))

    @property
    def waiting(self) -> int:
        """Return how many messages have not been decoded yet."""
        return len(self._kept)

    def drain(self, most: int | None = None) -> list[Fresh | Write]:
        """Return what has been seen since the last call, in ``most`` messages at most."""
        found: list[Fresh | Write] = []
        for _ in range(len(self._kept) if most is None else min(most, len(self._kept))):
            earliest, time, connection, port, up, message, state = self._kept.popleft()
            for whole in (message,) if up else self._joined(connection, port, message):
                seen = self._decoder.feed(time, connection, port, up, whole, state)
                found += (item._replace(earliest=earliest) for item in seen)
        return found

    def _joined(self, connection: int, port: str, piece: bytes) -> list[bytes]:
        """Return the messages that are whole for the client: harm may have split them."""
        splitter = self._whole.setdefault(connection, self._splitters[port]())
        return splitter.feed(piece)
