"""Two clocks tied together by the quickest of many arrivals."""

from __future__ import annotations

DRIFT = 1e-4  # s per s: what two clocks may drift apart, and how fast the bound follows
JUMP = 0.5  # s: a clock that is off by more was set anew


class ClockOffset:
    """How far another clock lags this machine's monotonic one, by a minimum filter over arrivals.

    Every arrival comes late by some delay; the least delay seen is the offset. What is constant in
    the delay cannot be distinguished from an offset by arrivals alone.
    """

    def __init__(self) -> None:
        self._offset: float | None = None  # s, monotonic minus theirs
        self._last = 0.0  # s, theirs

    def take(self, theirs: float, received: float) -> float:
        """Take an arrival (s, monotonic) of a sample stamped ``theirs``; returns its stamp here.

        The result is never later than ``received``. A clock that jumps starts the estimate anew.
        """
        lead, gap = received - theirs, theirs - self._last
        self._last = theirs
        if self._offset is None or gap < 0.0 or lead - self._offset > JUMP:
            self._offset = lead
        self._offset = min(lead, self._offset + DRIFT * gap)
        return min(theirs + self._offset, received)
