"""What a proxy does to messages on their way: pass, change, delay, lose, double, reorder."""

from __future__ import annotations

import threading
from collections.abc import Callable

Outcome = list[tuple[float, bytes]]
"""What leaves instead of one message: (s of delay, bytes), none where it is lost."""
Mischief = Callable[[bytes], Outcome]


def passing(message: bytes) -> Outcome:
    """Pass a message on as it is."""
    return [(0.0, message)]


def losing(message: bytes) -> Outcome:
    """Lose it."""
    return []


def delaying(seconds: float) -> Mischief:
    """Pass messages on late."""
    return lambda message: [(seconds, message)]


def changing(change: Callable[[bytes], bytes]) -> Mischief:
    """Pass what ``change`` makes of each message."""
    return lambda message: [(0.0, change(message))]


def doubling(message: bytes) -> Outcome:
    """Pass it twice."""
    return [(0.0, message), (0.0, message)]


def reordering() -> Mischief:
    """Swap each two messages that follow each other."""
    kept: list[bytes] = []

    def swap(message: bytes) -> Outcome:
        if not kept:
            kept.append(message)
            return []
        return [(0.0, message), (0.0, kept.pop())]

    return swap


class Times:
    """A mischief that happens to the next ``count`` messages that ``which`` chooses.

    ``done`` is set when the last one has gone through.
    """

    def __init__(
        self, mischief: Mischief, count: int, which: Callable[[bytes], bool] = lambda _: True
    ) -> None:
        self._mischief, self._left, self._which = mischief, count, which
        self.done = threading.Event()

    def __call__(self, message: bytes) -> Outcome:
        """Do it, or pass the message on."""
        if self._left <= 0 or not self._which(message):
            return [(0.0, message)]
        self._left -= 1
        if not self._left:
            self.done.set()
        return self._mischief(message)
