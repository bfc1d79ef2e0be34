"""Whether a cell's rate is one that its controller has."""

from __future__ import annotations

from collections import deque

GAPS = 5  # between states, before the controller's rate counts as known
GAPS_KEPT = 50  # gaps between states that are remembered
RATE_TOLERANCE = 1.5  # cycles of the cell: bound of the shortest gap between states


class RateCheck:
    """Compares the cell's rate with the controller's update rate."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._last: float | None = None  # s, controller clock
        self._gaps: deque[float] = deque(maxlen=GAPS_KEPT)

    def take(self, timestamp: float) -> None:
        """Add a state's timestamp, s, controller clock."""
        if self._last is not None and timestamp > self._last:
            self._gaps.append(timestamp - self._last)
        self._last = timestamp

    @property
    def known(self) -> bool:
        """Return whether there are enough states for the check."""
        return len(self._gaps) >= GAPS

    @property
    def problem(self) -> str:
        """Return a message if the cell's rate is above the controller's; empty: it is not.

        The shortest gap is the controller's period: delays only lengthen gaps.
        """
        shortest = min(self._gaps, default=0.0)
        if shortest <= RATE_TOLERANCE / self._rate:
            return ""
        return (
            f"link.rate: found {self._rate:g} Hz, expected at most {1.0 / shortest:.4g} Hz: the "
            f"controller has a new state every {1e3 * shortest:.3g} ms"
        )
