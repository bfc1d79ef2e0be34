"""Deadlines missed: a loop that cannot keep pace must not go on writing."""

from __future__ import annotations

from collections import deque

SPAN = 1.0  # s
MOST = 0.05  # share of a span's cycles that may be missed


class OverrunWatch:
    """Counts the cycles that the loop's own work took from those after it, within a span."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._missed: deque[tuple[float, int]] = deque()  # s, cycles
        self._sum = 0

    def forget(self) -> None:
        """Begin anew: the loop did something else meanwhile."""
        self._missed.clear()
        self._sum = 0

    def update(self, now: float, missed: int) -> str | None:
        """Take the cycles missed before this one; return in words that they are too many."""
        queue = self._missed
        while queue and now - queue[0][0] > SPAN:
            self._sum -= queue.popleft()[1]
        if not missed:
            return None
        queue.append((now, missed))
        self._sum += missed
        if self._sum <= MOST * SPAN * self._rate or len(queue) < 2:
            return None  # a single long one is judged by the gap that it leaves
        words = f"{self._sum} of {SPAN * self._rate:.0f} cycles missed within {SPAN:g} s"
        self.forget()
        return words
