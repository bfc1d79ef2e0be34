"""The robot's own program, where setpoints ride on it: from pose to pose, with a rest at each."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

import numpy as np

from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.demo.bench import Bench
from gapbridge.bridge.loop.supervisor import State
from gapbridge.core.arrays import Array
from gapbridge.core.errors import LinkError
from gapbridge.drivers.simulated.server.arm_controller import OWN_ACCELERATION, OWN_SPEED

LONGEST_START = 60.0  # s until the daemon writes
RAMP = 0.8  # s until offsets are in
REST = 0.35  # s at each pose, from when it is seen to stand
LONGEST_VISIT = 15.0  # s


def travel_time(start: Array, goal: Array) -> float:
    """Return how long (s) the program's joint move takes: a trapezoid of the leading joint."""
    way = float(np.abs(goal - start).max())
    if way < OWN_SPEED**2 / OWN_ACCELERATION:
        return 2.0 * float(np.sqrt(way / OWN_ACCELERATION))
    return way / OWN_SPEED + OWN_SPEED / OWN_ACCELERATION


class OwnProgram(threading.Thread):
    """Visits poses as soon as the daemon writes, then has the daemon stop."""

    def __init__(
        self, daemon: Daemon, bench: Callable[[], Bench], home: Array, poses: Array
    ) -> None:
        super().__init__(name="robot's own program", daemon=True)
        self._daemon, self._open, self._home, self._poses = daemon, bench, home, poses
        self._over = threading.Event()
        self._error: LinkError | None = None

    def run(self) -> None:
        """Wait for the daemon, visit the poses and end the run; a lost daemon ends the program."""
        try:
            if self._wait_writing():
                self._visit()
        except LinkError as error:
            self._error = error
        finally:
            self._daemon.stop()

    def _wait_writing(self) -> bool:
        latest = time.monotonic() + LONGEST_START
        while time.monotonic() < latest:
            if self._daemon.state == State.COMPENSATING:
                return not self._over.wait(RAMP)
            if self._over.wait(0.05):
                return False
        return False

    def _visit(self) -> None:
        bench = self._open()
        try:
            here = self._home
            for pose in (*self._poses, self._home):
                if not self._daemon.state.writes:
                    return
                bench.go(pose, travel_time(here, pose))
                here = pose
                if self._over.wait(REST):
                    return
        finally:
            bench.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        self.join(LONGEST_VISIT)
        if self._error is not None and error is None:
            raise self._error
