"""The clock that loop, daemon and drivers read and wait by.

Modules of the bridge and of the drivers get a clock as an argument, so that a simulation can run a
loop, a daemon and a controller in simulated time. Entry points name the system's and hand it on;
what waits for real processes and sockets uses the system's time (see the list in pyproject.toml).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Clock:
    """The system's time. Its functions are attributes, so that a call has no overhead."""

    monotonic: Callable[[], float]  # s, never decreases; arbitrary origin
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
