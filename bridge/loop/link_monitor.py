"""Watching the link: which states are believed, and how long silence may last."""

from __future__ import annotations

import math

from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.loop_counters import DROPPED, LoopCounter
from gapbridge.bridge.loop.reports import Reports
from gapbridge.bridge.loop.supervisor import Cause, Supervisor
from gapbridge.core.errors import Implausible, InvalidStateError, LinkError, StaleStateError
from gapbridge.core.state import RobotState
from gapbridge.drivers.clock import SYSTEM, Clock
from gapbridge.drivers.driver import Driver

DRIFT = 5e-3  # s per s: how fast the bound follows a clock that drifts or stumbles
INVALID_IN_A_ROW = 3  # states that cannot be believed, after which they count as silence
LEAP = 0.01  # s that the controller's clock may pass ours by from one sample to the next
AGREES = 2e-3  # s by which two samples may have come differently quickly and agree
AGREEING_IN_A_ROW = 5  # samples as quick as before a leap, after which it was none
OLD_IN_A_ROW = 2  # states too old to write by, after which they count as none
SILENCE = 0.2  # s without a state: a fault
LOST = 3.0  # s without a state: the link is lost
LOST_AFTER_WRITING = 0.5  # s: the library's writing half does not survive a break
SUSPENDED = 0.1  # s that a reading takes longer than it may: this process was stopped meanwhile
REPORT_EVERY = 1.0  # s between two events of samples dropped for the same reason


def hold_time(rate: float) -> float:
    """Return for how long the last offset may stay without a new state, s: 5 cycles or 40 ms."""
    return min(max(5.0 / rate, 0.04), SILENCE)


class ControllerClock:
    """Ties controller time to this machine's monotonic clock by the quickest sample seen.

    The age of a state counts from when its sample could have been here at the earliest, so that
    late packets, late wake-ups and long computing all count. The shortest way over the wire, which
    one clock alone cannot show, does not: see ``Driver.way``. ``hold``: s after which a state is
    too old to write by.
    What a stalled link hands on at once is old for a moment only. Where all samples are older than
    that for as long, either the controller's clock has stood still or the way has become longer,
    which no clock shows: the two are tied anew only while the driver is not armed, since arming
    measures the way to the controller and nothing is written before.
    Where the controller's clock passes this machine's, either it has been set forward or the link
    hands on what it held back: the sample counts as the next one after the last, until some in a
    row come as quick as those before.
    """

    def __init__(self, rate: float, hold: float = 1.0, clock: Clock = SYSTEM) -> None:
        self._now = clock.monotonic
        self._rate, self._hold = rate, hold
        self._lead: float | None = None  # s: monotonic minus controller time, quickest sample
        self._last: tuple[float, float] | None = None  # s: controller clock, monotonic
        self._counts = True  # the cycles missed since the last sample are this loop's
        self._quickest: float | None = None  # s, as _lead, before the controller's clock leapt
        self._agreeing = 0  # samples in a row that are as quick as that
        self._old_since: float | None = None  # s, monotonic: all samples have been old since

    def take(self, state: RobotState, way_known: bool = False) -> int:
        """Take a new sample; returns the cycles missed since the one before.

        ``way_known``: arming has measured the way to the controller, beside the samples so far;
        later ones that are older stay old.
        """
        lead, before, counts = state.received - state.timestamp, self._last, self._counts
        self._last, self._counts = (state.timestamp, state.received), True
        gap = 0.0 if before is None else state.timestamp - before[0]
        if self._lead is None or (self._stood_still(lead, state.received) and not way_known):
            self._lead, self._old_since, self._quickest = lead, None, None
        else:
            # not over a break: the first state after it would count as younger than it can be
            drifted = self._lead + DRIFT * (gap if gap <= self._hold else 0.0)
            elapsed = 0.0 if before is None else state.received - before[1]
            leapt = gap - 1.0 / self._rate if gap - elapsed > LEAP else 0.0
            self._lead = min(lead, self._lead_after_leap(lead, drifted, leapt))
        return max(round(gap * self._rate) - 1, 0) if counts and before is not None else 0

    def _lead_after_leap(self, lead: float, drifted: float, leapt: float) -> float:
        """Return the lead (s) that counts where the controller's clock may have leapt.

        ``leapt``: by how much (s) at this sample, zero where it has not; ``drifted``: the lead
        that counts where it never has.
        """
        if leapt > 0.0:
            if self._quickest is None:
                self._quickest = drifted
            self._agreeing = 0
            drifted = min(drifted, self._quickest - leapt)
        if self._quickest is None:
            return drifted
        later = lead - self._quickest
        self._agreeing = self._agreeing + 1 if abs(later) <= AGREES else 0
        if self._agreeing >= AGREEING_IN_A_ROW:
            drifted, self._quickest = self._quickest, None
        elif later < -AGREES:  # quicker than any before: it has been set
            self._quickest = None
        return drifted

    def _stood_still(self, lead: float, now: float) -> bool:
        """Return whether samples have come too old for long enough."""
        if self._lead is None or lead - self._lead <= self._hold:
            self._old_since = None
        elif self._old_since is None:
            self._old_since = now
        return self._old_since is not None and now - self._old_since > self._hold

    def skip(self) -> None:
        """Do not count what the loop does not see now as missed: it does something else."""
        self._counts = False

    def age(self, state: RobotState) -> float:
        """Return how old a state is now, s."""
        return self._now() - self._due(state)

    def expiry(self, state: RobotState) -> float:
        """Return when a state becomes too old for a setpoint to be made of it, s monotonic."""
        return self._due(state) + self._hold

    def _due(self, state: RobotState) -> float:
        return state.timestamp + (self._lead or 0.0)


class LinkMonitor:
    """Takes states from a driver and notifies the supervisor when they fail to come.

    ``lost`` says why the link must be given up, from then on.
    """

    def __init__(
        self,
        driver: Driver,
        supervisor: Supervisor,
        reports: Reports,
        patience: float = 0.0,
    ) -> None:
        self._driver, self._supervisor, self._reports = driver, supervisor, reports
        self._now = driver.clock.monotonic
        self.lost: str | None = None
        self._hold = hold_time(driver.rate)
        self._patience = max(patience, self._hold)  # s that one reading takes at most
        self._invalid = self._old = 0
        self._last_read_end = 0.0  # s, monotonic: when the last reading ended
        self._stale = self._silent = False  # has been reported since the last believable state
        self._reported: dict[Implausible, float] = {}  # s, monotonic
        self._last_state = self._now()  # s, of the last believable state
        self._has_armed = False

    def next(self, has_armed: bool = False) -> RobotState | None:
        """Return the next state, or None where none came that can be used.

        ``has_armed``: the writing half of the robot's library exists in this process.
        """
        self._has_armed = has_armed
        begun, self._last_read_end = self._now(), self._last_read_end or self._now()
        suspended = begun - self._last_read_end > self._hold
        try:
            return self._read(begun, suspended)
        finally:
            self._last_read_end = self._now()

    def _read(self, begun: float, suspended: bool) -> RobotState | None:
        """Return the next state; ``away``: this process itself stood still before ``begun``."""
        try:
            state = self._driver.read_state()
        except StaleStateError as error:
            if suspended or self._now() - begun > self._patience + SUSPENDED:
                self._last_state = self._now()  # it was this process that slept: ask once more
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
        """Take note of a state that is fine; returns whether it is fresh enough to write by.

        One that was too old (``expiry``, s monotonic) when it could be used is late, and several
        in a row are a link on which nothing fresh comes any more.
        """
        now = self._now()
        self._old = self._old + 1 if now > expiry else 0
        self._invalid = 0
        if self._old >= OLD_IN_A_ROW:
            self._judge_stale(f"states are {now - expiry + self._hold:.3f} s old as they come")
            return False
        if self._old:
            self._reports.count(LoopCounter.LATE)
            return False
        self._last_state = now
        self._stale = self._silent = False
        return True

    def reset(self) -> None:
        """Take note that nobody asked for states meanwhile."""
        self._last_state = self._last_read_end = self._now()

    def _judge_stale(self, detail: str) -> None:
        """Judge a clock that stands still: late at first, then stale, then silent."""
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
        """Drop a state that cannot be believed; several in a row end the compensation."""
        detail, reason = str(error), error.reason
        count = DROPPED[reason]
        self._reports.count(count)
        self._invalid += 1
        now = self._now()
        if now - self._reported.get(reason, -REPORT_EVERY) >= REPORT_EVERY:
            self._reported[reason] = now
            self._reports.emit({"kind": EventKind.DROPPED, "what": count.label, "detail": detail})
        if self._invalid >= INVALID_IN_A_ROW:
            self._supervisor.take(Cause.IMPLAUSIBLE, detail)
            self._driver.forget()  # the arm may well be there: judge what comes by itself
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
