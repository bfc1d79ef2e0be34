"""The controller's clock seen from here: cycles missed, and how old a state is."""

from __future__ import annotations

import time

from core.state import RobotState

DRIFT = 5e-3  # s per s: how fast the bound follows a clock that drifts or stumbles


class ControllerClock:
    """Ties controller time to this machine's monotonic clock by the quickest sample seen.

    The age of a state counts from when its sample could have been here at the earliest, so that
    late packets, late wake-ups and long computing all count. The shortest way over the wire, which
    one clock alone cannot tell, does not. ``hold``: s without a sample after which the two clocks
    are tied anew, because the controller's may have stood still.
    """

    def __init__(self, rate: float, hold: float = 1.0) -> None:
        self._rate, self._hold = rate, hold
        self._lead: float | None = None  # s: monotonic minus controller time, quickest sample
        self._last: float | None = None  # s, controller clock
        self._received = 0.0  # s, monotonic: of the last sample

    def take(self, state: RobotState) -> int:
        """Take a new sample; returns the cycles missed since the one before."""
        lead, before = state.received - state.timestamp, self._last
        silence, self._received = state.received - self._received, state.received
        self._last = state.timestamp
        gap = 0.0 if before is None else state.timestamp - before
        if self._lead is None or silence > self._hold:
            self._lead = lead
        else:
            self._lead = min(lead, self._lead + DRIFT * gap)
        return 0 if before is None else max(round(gap * self._rate) - 1, 0)

    def skip(self) -> None:
        """Do not count what the loop does not see now as missed: it does something else."""
        self._last = None

    def age(self, state: RobotState) -> float:
        """Return how old a state is now, s."""
        return time.monotonic() - self._due(state)

    def expiry(self, state: RobotState) -> float:
        """Return when a state becomes too old for a setpoint to be made of it, s monotonic."""
        return self._due(state) + self._hold

    def _due(self, state: RobotState) -> float:
        return state.timestamp + (self._lead or 0.0)
