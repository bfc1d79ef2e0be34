"""Whether a sample is new, by the controller's clock, and its timestamp."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.drivers.modbus.registers import UNITS
from gapbridge.drivers.modbus.schema import Clock, ProfileFile

MOVING = 0.05  # rad/s: a joint that reports this velocity must change its angle


class Freshness:
    """Follows the controller's clock, counter or heartbeat from sample to sample.

    Without one, an answer is new when it arrives, unless the joints are bit-identical while their
    velocities are not zero.
    """

    def __init__(self, profile: ProfileFile) -> None:
        self._clock = profile.clock
        self.has_clock = profile.clock is not None and profile.clock.kind != "heartbeat"
        self._step = _step(profile.clock, profile.period)
        self._wrap = _wrap(profile.clock)
        self._count: float | None = None
        self._time = 0.0
        self._q: Array | None = None

    def restart(self) -> None:
        """Drop the previous sample: the next one counts as new."""
        self._count, self._q = None, None

    def is_new(self, count: float | None, q: Array, qd: Array | None) -> bool:
        """Return whether a sample with this clock count is not the one before."""
        if self._clock is not None:
            return count != self._count
        # a list: faster than an array of six
        if self._q is None or qd is None or max(map(abs, qd.tolist())) <= MOVING:
            return True
        return not np.array_equal(q, self._q)

    def take(self, count: float | None, q: Array, received: float) -> float:
        """Store a new sample; returns its timestamp, s, which never decreases.

        It is the controller's time with a timestamp or counter, otherwise the time of arrival.
        """
        before, self._count, self._q = self._count, count, q
        if count is None or not self.has_clock:
            self._time = received
            return received
        if before is None:
            self._time = max(self._time, count * self._step)
            return self._time
        ahead = count - before
        if self._wrap:
            ahead %= self._wrap
            if ahead > 0.5 * self._wrap:  # it went back: the controller has restarted
                ahead = 1.0
        self._time += max(ahead, 1.0 if self._wrap else 0.0) * self._step
        return self._time


def _step(clock: Clock | None, period: float) -> float:
    """Return s per count."""
    if clock is None:
        return 0.0
    if clock.kind == "timestamp":
        return clock.scale * UNITS[clock.unit][1]
    return clock.scale * period


def _wrap(clock: Clock | None) -> float:
    """Return after how many counts the clock wraps; 0: never."""
    if clock is None or clock.type.startswith("f"):
        return 0.0
    low, high = clock.coding.limits
    return high - low + 1.0
