"""Watching the link: which states are believed, and how long silence may last."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from gapbridge.bridge.ipc.counts import Count
from gapbridge.bridge.ipc.shared_memory import Page
from gapbridge.bridge.loop.sample_check import SampleCheck
from gapbridge.bridge.loop.supervisor import Cause, Supervisor
from gapbridge.core.arm import Arm
from gapbridge.core.errors import InvalidStateError, LinkError, StaleStateError
from gapbridge.core.state import RobotState
from gapbridge.drivers.driver import Driver

INVALID_IN_A_ROW = 3  # states that cannot be believed, after which they count as silence
OLD_IN_A_ROW = 2  # states too old to write by, after which they count as none
SILENCE = 0.2  # s without a state: a fault
LOST = 3.0  # s without a state: the link is lost
LOST_AFTER_WRITING = 0.5  # s: the library's writing half does not survive a break
SUSPENDED = 0.1  # s that a reading takes longer than it may: this process was stopped meanwhile
TELL_EVERY = 1.0  # s between two events of samples dropped for the same reason


def hold_time(rate: float) -> float:
    """Return for how long the last offset may stay without a new state, s: 5 cycles or 40 ms."""
    return min(max(5.0 / rate, 0.04), SILENCE)


class StateWatch:
    """Takes states from a driver and notifies the supervisor when they fail to come.

    ``lose`` is called with the reason when the link must be given up.
    """

    def __init__(
        self,
        driver: Driver,
        arm: Arm,
        supervisor: Supervisor,
        page: Page,
        tell: Callable[[dict[str, Any]], None],
        lose: Callable[[str], None],
        patience: float = 0.0,
    ) -> None:
        self._driver, self._supervisor, self._page = driver, supervisor, page
        self._tell, self._lose = tell, lose
        self._hold = hold_time(driver.rate)
        self._patience = max(patience, self._hold)  # s that one reading takes at most
        self._check = SampleCheck(arm)
        self._invalid = self._old = 0
        self._left = 0.0  # s, monotonic: when the last reading ended
        self._stale = self._silent = False  # has been reported since the last believable state
        self._told: dict[Count, float] = {}  # s, monotonic
        self._heard = time.monotonic()  # s, of the last believable state
        self.has_written = False  # the library's writing half exists in this process

    def next(self) -> RobotState | None:
        """Return the next state, or None where none came that can be used."""
        begun, self._left = time.monotonic(), self._left or time.monotonic()
        away = begun - self._left > self._hold
        try:
            return self._read(begun, away)
        finally:
            self._left = time.monotonic()

    def _read(self, begun: float, away: bool) -> RobotState | None:
        """Return the next state; ``away``: this process itself stood still before ``begun``."""
        try:
            state = self._driver.read_state()
        except StaleStateError as error:
            if away or time.monotonic() - begun > self._patience + SUSPENDED:
                self._heard = time.monotonic()  # it was this process that slept: ask once more
                self._page.count(Count.LATE)
            else:
                self._stand_still(str(error))
        except InvalidStateError as error:
            self.doubt(str(error))
        except LinkError as error:
            self._lose(str(error))
        else:
            doubt = self._check.doubt(state)
            if doubt is None:
                return state
            self.doubt(doubt.words, doubt.count)
        return None

    def believe(self, expiry: float = math.inf) -> bool:
        """Take note of a state that is fine; returns whether it is fresh enough to write by.

        One that was too old (``expiry``, s monotonic) when it could be used is late, and several
        in a row are a link on which nothing fresh comes any more.
        """
        now = time.monotonic()
        self._old = self._old + 1 if now > expiry else 0
        self._invalid = 0
        if self._old >= OLD_IN_A_ROW:
            self._stand_still(f"states are {now - expiry + self._hold:.3f} s old as they come")
            return False
        if self._old:
            self._page.count(Count.LATE)
            return False
        self._heard = now
        self._stale = self._silent = False
        return True

    def forget(self) -> None:
        """Take note that nobody asked for states meanwhile."""
        self._check.forget()
        self._heard = self._left = time.monotonic()

    def _stand_still(self, detail: str) -> None:
        """Judge a clock that stands still: late at first, then stale, then silent."""
        if time.monotonic() - self._heard <= self._hold:
            self._page.count(Count.LATE)
            return
        if not self._stale:
            self._stale = True
            self._page.count(Count.STALE)
            if not self._supervisor.take(Cause.STALE, detail):
                self._tell({"kind": "link", "what": "stale", "detail": detail})
        self._fall_silent(detail)

    def doubt(self, detail: str, reason: Count = Count.DROPPED_TORN) -> None:
        """Drop a state that cannot be believed; several in a row end the compensation."""
        self._page.count(reason)
        self._invalid += 1
        now = time.monotonic()
        if now - self._told.get(reason, -TELL_EVERY) >= TELL_EVERY:
            self._told[reason] = now
            self._tell({"kind": "dropped", "what": reason.label, "detail": detail})
        if self._invalid >= INVALID_IN_A_ROW:
            self._supervisor.take(Cause.IMPLAUSIBLE, detail)
            self._check.forget()  # the arm may well be there: judge what comes by itself
        self._fall_silent(detail)

    def _fall_silent(self, detail: str) -> None:
        silent = time.monotonic() - self._heard
        if silent > SILENCE:
            if not self._silent:
                self._silent = True
                self._page.count(Count.SILENCE)
            self._supervisor.take(Cause.SILENCE, detail)
        if silent > (LOST_AFTER_WRITING if self.has_written else LOST):
            self._lose(detail)
