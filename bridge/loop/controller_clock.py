"""The controller's clock seen from here: cycles missed, and how old a state is."""

from __future__ import annotations

import time

from gapbridge.core.state import RobotState

DRIFT = 5e-3  # s per s: how fast the bound follows a clock that drifts or stumbles


class ControllerClock:
    """Ties controller time to this machine's monotonic clock by the quickest sample seen.

    The age of a state counts from when its sample could have been here at the earliest, so that
    late packets, late wake-ups and long computing all count. The shortest way over the wire, which
    one clock alone cannot show, does not. ``hold``: s after which a state is too old to write by.
    What a stalled link hands on at once is old for a moment only. Where all samples are older than
    that for as long, either the controller's clock has stood still or the way has become longer,
    which no clock shows: the two are tied anew only while nothing is written.
    """

    def __init__(self, rate: float, hold: float = 1.0) -> None:
        self._rate, self._hold = rate, hold
        self._lead: float | None = None  # s: monotonic minus controller time, quickest sample
        self._last: float | None = None  # s, controller clock
        self._old_since: float | None = None  # s, monotonic: all samples have been old since

    def take(self, state: RobotState, writes: bool = False) -> int:
        """Take a new sample; returns the cycles missed since the one before.

        ``writes``: setpoints are made of the samples, so that old ones stay old.
        """
        lead, before = state.received - state.timestamp, self._last
        self._last = state.timestamp
        gap = 0.0 if before is None else state.timestamp - before
        if self._lead is None or (self._stood_still(lead, state.received) and not writes):
            self._lead, self._old_since = lead, None
        else:
            self._lead = min(lead, self._lead + DRIFT * gap)
        return 0 if before is None else max(round(gap * self._rate) - 1, 0)

    def _stood_still(self, lead: float, now: float) -> bool:
        """Return whether samples have come too old for long enough."""
        if self._lead is None or lead - self._lead <= self._hold:
            self._old_since = None
        elif self._old_since is None:
            self._old_since = now
        return self._old_since is not None and now - self._old_since > self._hold

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
