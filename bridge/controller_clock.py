"""The controller's clock seen from here: cycles missed, and how old a state is."""

from __future__ import annotations

import time

from core.state import RobotState

DRIFT = 1e-4  # s per s: what two clocks may drift apart, and how fast the bound follows


class ControllerClock:
    """Ties controller time to this machine's monotonic clock by the quickest sample seen.

    The age of a state counts from when its sample could have been here at the earliest, so that
    late packets, late wake-ups and long computing all count. The shortest way over the wire, which
    one clock alone cannot tell, does not.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._lead: float | None = None  # s: monotonic minus controller time, quickest sample
        self._last: float | None = None  # s, controller clock

    def take(self, state: RobotState) -> int:
        """Take a new sample; returns the cycles missed since the one before."""
        lead, before = state.received - state.timestamp, self._last
        self._last = state.timestamp
        if self._lead is None or before is None:
            self._lead = lead if self._lead is None else min(lead, self._lead)
            return 0
        gap = state.timestamp - before
        self._lead = min(lead, self._lead + DRIFT * gap)
        return max(round(gap * self._rate) - 1, 0)

    def skip(self) -> None:
        """Do not count what the loop does not see now as missed: it does something else."""
        self._last = None

    def age(self, state: RobotState) -> float:
        """Return how old a state is now, s."""
        return time.monotonic() - state.timestamp - (self._lead or 0.0)
