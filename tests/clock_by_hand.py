"""A clock that stands still but for those who sleep by it."""

from __future__ import annotations

from gapbridge.drivers.clock import Clock


class ByHand(Clock):
    """A clock that goes on where somebody sleeps."""

    def __init__(self) -> None:
        self.now = 100.0
        self.monotonic = self.time = lambda: self.now
        self.sleep = self._pass

    def _pass(self, seconds: float) -> None:
        self.now += seconds
