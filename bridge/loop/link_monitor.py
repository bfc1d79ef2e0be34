"""Monitoring the link: the age of states, invalid states, and how long silence may last."""

from __future__ import annotations

import math

from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.loop_counters import DROPPED, LoopCounter
from gapbridge.bridge.loop.reports import Reports
from gapbridge.bridge.loop.supervisor import Cause, Supervisor
from gapbridge.core.errors import Implausible, InvalidStateError, LinkError, StaleStateError
from gapbridge.core.state import RobotState
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.driver import Driver

DRIFT = 1e-3  # s per s: how fast the clock offset may grow: quartz 1e-4, a clock set by NTP 5e-4
GROWTH = 5e-3  # s by which it may grow once armed, beyond what a round trip has shown
ROUND_TRIP_SPAN = 1.0  # s of which the earliest sample and the shortest round trip are compared
INVALID_STATE_LIMIT = 3  # implausible states in a row that end the compensation
CLOCK_STEP = 0.01  # s that the controller's clock may gain on ours from one sample to the next
STEP_TOLERANCE = 2e-3  # s: clock offsets that differ by less agree
STEP_REVOKED_AFTER = 5  # samples with the offset from before a step: the clock was not set
OLD_STATE_LIMIT = 2  # states in a row too old to write by, after which the link is stale
SILENCE = 0.2  # s without a state: a fault
LOST = 3.0  # s without a state: the link is lost
LOST_AFTER_WRITING = 0.5  # s, once armed: the library cannot write after a break
SUSPENDED = 0.1  # s over the read timeout: this process was suspended meanwhile
REPORT_EVERY = 1.0  # s between two events of samples dropped for the same reason


def hold_time(rate: float) -> float:
    """Return how long the last offset may be held without a new state, s: 5 cycles or 40 ms."""
    return min(max(5.0 / rate, 0.04), SILENCE)


class ControllerClock:
    """Estimates the offset between the controller's clock and this machine's monotonic clock.

    The offset is the smallest difference (arrival minus timestamp) seen, so that the age of a state
    includes late packets, late wake-ups and computing time. It excludes the shortest transit time
    over the link, which one clock cannot show: see ``Driver.transit_time``. ``hold``: s after which
    a state is too old to write by.
    Samples that a stalled link delivers in a burst are old only for a moment. If all samples are
    older than ``hold`` for as long, either the controller's clock stopped or the transit time grew,
    which no clock shows: the offset is estimated again only while the driver is not armed, since
    arming measures the round trip before anything is written.
    A delay that grows slowly looks like drift. Once armed, the offset therefore follows by GROWTH
    at most, and further only as far as another round trip shows that it was drift (``measured``).
    If the controller's clock gains on this machine's, either it was set forward or the link
    delivers delayed samples: the sample counts as one period after the last, until some in a row
    agree with the offset from before.
    """

    def __init__(self, rate: float, clock: Clock, hold: float = 1.0) -> None:
        self._now = clock.monotonic
        self._rate, self._hold = rate, hold
        self._offset: float | None = None  # s: monotonic minus controller time
        self._last: tuple[float, float] | None = None  # s: controller clock, monotonic
        self._counts = True  # cycles missed since the last sample count
        self._offset_before_step: float | None = None  # s, of the controller's clock
        self._agreeing = 0  # samples in a row that agree with that offset
        self._old_since: float | None = None  # s, monotonic: all samples since were old
        self._most_offset = math.inf  # s: the offset follows drift no further
        self._restart_span(0.0)

    def _restart_span(self, now: float) -> None:
        self._span_begin = now  # s, monotonic
        self._earliest = self._shortest = math.inf  # s: offset of a sample, round trip

    def take(self, state: RobotState, transit_known: bool = False) -> int:
        """Take a new sample; returns the cycles missed since the one before.

        ``transit_known``: arming has measured the round trip, which holds for the present offset:
        samples that are older stay old.
        """
        offset, before, counts = state.received - state.timestamp, self._last, self._counts
        self._last, self._counts = (state.timestamp, state.received), True
        gap = 0.0 if before is None else state.timestamp - before[0]
        if not transit_known:
            self._most_offset = math.inf
            self._restart_span(state.received)
        elif self._offset is not None and self._most_offset == math.inf:
            self._most_offset = self._offset + GROWTH
        self._earliest = min(self._earliest, offset)
        if self._offset is None or (self._outdated(offset, state.received) and not transit_known):
            self._offset, self._old_since, self._offset_before_step = offset, None, None
        else:
            # no drift over a gap: the first state after it would seem younger than it can be
            drifted = self._offset + DRIFT * (gap if gap <= self._hold else 0.0)
            drifted = max(min(drifted, self._most_offset), self._offset)
            elapsed = 0.0 if before is None else state.received - before[1]
            step = gap - 1.0 / self._rate if gap - elapsed > CLOCK_STEP else 0.0
            self._offset = min(offset, self._offset_after_step(offset, drifted, step))
            self._most_offset = min(self._most_offset, offset + GROWTH)
        return max(round(gap * self._rate) - 1, 0) if counts and before is not None else 0

    def _offset_after_step(self, offset: float, drifted: float, step: float) -> float:
        """Return the offset (s) to use, given a possible step of the controller's clock.

        ``offset``: of this sample, s; ``drifted``: the present offset with drift, s; ``step``: the
        step at this sample, s, or zero.
        """
        if step > 0.0:
            if self._offset_before_step is None:
                self._offset_before_step = drifted
            self._agreeing = 0
            drifted = min(drifted, self._offset_before_step - step)
        if self._offset_before_step is None:
            return drifted
        later = offset - self._offset_before_step
        self._agreeing = self._agreeing + 1 if abs(later) <= STEP_TOLERANCE else 0
        if self._agreeing >= STEP_REVOKED_AFTER:
            drifted, self._offset_before_step = self._offset_before_step, None
            self._most_offset = max(self._most_offset, drifted + GROWTH)
        elif later < -STEP_TOLERANCE:  # earlier than any sample before: the clock was set
            self._offset_before_step = None
        return drifted

    def _outdated(self, offset: float, now: float) -> bool:
        """Return whether all samples have been too old for longer than ``hold``."""
        if self._offset is None or offset - self._offset <= self._hold:
            self._old_since = None
        elif self._old_since is None:
            self._old_since = now
        return self._old_since is not None and now - self._old_since > self._hold

    def measured(self, round_trip: float, transit_time: float) -> None:
        """Take a round trip (s) just measured; ``transit_time``: that counts in every age, s.

        No sample was under way for longer than the shortest round trip of the same time.
        """
        self._shortest = min(self._shortest, round_trip)
        now = self._now()
        if now - self._span_begin >= ROUND_TRIP_SPAN:
            shown = self._earliest - self._shortest + transit_time
            self._most_offset = max(self._most_offset, shown + GROWTH)
            self._restart_span(now)

    def skip(self) -> None:
        """Do not count the cycles until the next sample as missed: the loop does not read."""
        self._counts = False

    def age(self, state: RobotState) -> float:
        """Return how old a state is now, s."""
        return self._now() - self._due(state)

    def expiry(self, state: RobotState) -> float:
        """Return when a state becomes too old to compute a setpoint from it, s monotonic."""
        return self._due(state) + self._hold

    def _due(self, state: RobotState) -> float:
        return state.timestamp + (self._offset or 0.0)


class LinkMonitor:
    """Reads states from a driver and notifies the supervisor when none arrives.

    ``lost``: why the link is lost, once it is.
    """

    def __init__(
        self,
        driver: Driver,
        supervisor: Supervisor,
        reports: Reports,
        read_timeout: float = 0.0,
    ) -> None:
        self._driver, self._supervisor, self._reports = driver, supervisor, reports
        self._now = driver.clock.monotonic
        self.lost: str | None = None
        self._hold = hold_time(driver.rate)
        self._read_timeout = max(read_timeout, self._hold)  # s that one reading takes at most
        self._invalid = self._old = 0
        self._last_read_end = 0.0  # s, monotonic: when the last reading ended
        self._stale = self._silent = False  # reported since the last valid state
        self._reported: dict[Implausible, float] = {}  # s, monotonic
        self._last_state = self._now()  # s, monotonic: of the last valid state
        self._has_armed = False

    def next(self, has_armed: bool = False) -> RobotState | None:
        """Return the next valid state, or None.

        ``has_armed``: the driver has been armed in this process.
        """
        self._has_armed = has_armed
        begun, self._last_read_end = self._now(), self._last_read_end or self._now()
        suspended = begun - self._last_read_end > self._hold
        try:
            return self._read(begun, suspended)
        finally:
            self._last_read_end = self._now()

    def _read(self, begun: float, suspended: bool) -> RobotState | None:
        """Return the next state; ``suspended``: this process was, before ``begun`` (s)."""
        try:
            state = self._driver.read_state()
        except StaleStateError as error:
            if suspended or self._now() - begun > self._read_timeout + SUSPENDED:
                self._last_state = self._now()  # this process was suspended: try again
                self._reports.count(LoopCounter.LATE)
            else:
                self._judge_stale(str(error))
        except InvalidStateError as error:
            self.drop(error)
        except LinkError as error:
            self.lost = str(error)
        else:
            return state
        return None

    def accept(self, expiry: float = math.inf) -> bool:
        """Record a valid state; returns whether it is fresh enough to write by.

        A state past its ``expiry`` (s, monotonic) counts as late; several in a row make the link
        stale.
        """
        now = self._now()
        self._old = self._old + 1 if now > expiry else 0
        self._invalid = 0
        if self._old >= OLD_STATE_LIMIT:
            self._judge_stale(
                f"states are {now - expiry + self._hold:.3f} s old as they come: the link delays "
                "them, or a clock runs wrong"
            )
            return False
        if self._old:
            self._reports.count(LoopCounter.LATE)
            return False
        self._last_state = now
        self._stale = self._silent = False
        return True

    def reset(self) -> None:
        """Restart all timers: no states were read meanwhile."""
        self._last_state = self._last_read_end = self._now()

    def _judge_stale(self, detail: str) -> None:
        """Act on a missing state: late at first, then stale, then silent."""
        if self._now() - self._last_state <= self._hold:
            self._reports.count(LoopCounter.LATE)
            return
        if not self._stale:
            self._stale = True
            self._reports.count(LoopCounter.STALE)
            if not self._supervisor.take(Cause.STALE, detail):
                self._reports.emit({"kind": EventKind.LINK, "what": "stale", "detail": detail})
        self._judge_silence(detail)

    def drop(self, error: InvalidStateError) -> None:
        """Drop an implausible state; several in a row end the compensation."""
        detail, reason = str(error), error.reason
        count = DROPPED[reason]
        self._reports.count(count)
        self._invalid += 1
        now = self._now()
        if now - self._reported.get(reason, -REPORT_EVERY) >= REPORT_EVERY:
            self._reported[reason] = now
            self._reports.emit({"kind": EventKind.DROPPED, "what": count.label, "detail": detail})
        if self._invalid >= INVALID_STATE_LIMIT:
            self._supervisor.take(Cause.IMPLAUSIBLE, detail)
            self._driver.reset_check()  # the arm may be there: check the next state by itself
        self._judge_silence(detail)

    def _judge_silence(self, detail: str) -> None:
        silent = self._now() - self._last_state
        if silent > SILENCE:
            if not self._silent:
                self._silent = True
                self._reports.count(LoopCounter.SILENCE)
            self._supervisor.take(Cause.SILENCE, detail)
        if silent > (LOST_AFTER_WRITING if self._has_armed else LOST):
            self.lost = detail
