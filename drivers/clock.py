"""The one clock that everything in control reads, and waits by.

No module of the bridge or of the drivers reads the time by itself: each is given a clock, so that a
simulation can run a loop, a daemon and a controller in a time of its own. Where real processes and
sockets are waited for, time is the system's (see the list in pyproject.toml).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Clock:
    """The system's time. Its readings are plain attributes: a call costs what the system's does."""

    monotonic: Callable[[], float]  # s, never goes back; of no date
    time: Callable[[], float]  # s since 1970
    sleep: Callable[[float], None]  # s

    def __init__(self) -> None:
        self.monotonic = time.monotonic
        self.time = time.time
        self.sleep = time.sleep

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Wait until an event is set, ``seconds`` at most; return whether it is."""
        return event.wait(seconds)


SYSTEM = Clock()
