"""Watching the link: which states are believed, and how long silence may last."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from bridge.supervisor import Cause, Supervisor
from core.errors import InvalidStateError, LinkError, StaleStateError
from core.state import RobotState
from drivers.driver import Driver

INVALID_IN_A_ROW = 3  # states that cannot be believed, after which they count as silence
SILENCE = 0.2  # s without a state: a fault
LOST = 3.0  # s without a state: the link is lost
LOST_AFTER_WRITING = 0.5  # s: the library's writing half does not survive a break


class StateWatch:
    """Takes states from a driver and tells the supervisor when they fail to come.

    ``lose`` is called with the reason when the link must be given up.
    """

    def __init__(
        self,
        driver: Driver,
        supervisor: Supervisor,
        tell: Callable[[dict[str, Any]], None],
        lose: Callable[[str], None],
    ) -> None:
        self._driver, self._supervisor = driver, supervisor
        self._tell, self._lose = tell, lose
        self._invalid = 0
        self._heard = time.monotonic()  # s, of the last believable state
        self.has_written = False  # the library's writing half exists in this process

    def next(self) -> RobotState | None:
        """Return the next state, or None where none came that can be used."""
        try:
            return self._driver.read_state()
        except StaleStateError as error:
            self._supervisor.take(Cause.STALE, str(error))
            self._fall_silent(str(error))
        except InvalidStateError as error:
            self.doubt(str(error))
        except LinkError as error:
            self._lose(str(error))
        return None

    def believe(self) -> None:
        """Take note of a state that is fine."""
        self._heard, self._invalid = time.monotonic(), 0

    def doubt(self, detail: str) -> None:
        """Drop a state that cannot be believed; several in a row are as good as none."""
        self._invalid += 1
        if self._invalid == 1:
            self._tell({"dropped": detail})
        if self._invalid >= INVALID_IN_A_ROW:
            self._supervisor.take(Cause.STALE, detail)
        self._fall_silent(detail)

    def _fall_silent(self, detail: str) -> None:
        silent = time.monotonic() - self._heard
        if silent > SILENCE:
            self._supervisor.take(Cause.SILENCE, detail)
        if silent > (LOST_AFTER_WRITING if self.has_written else LOST):
            self._lose(detail)
