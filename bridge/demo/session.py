"""The cell during the demo: loads are hung, the daemon runs, the tracker looks on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.daemon.daemon import Daemon, settings_of
from gapbridge.bridge.daemon.summary import RunSummary
from gapbridge.bridge.demo.bench import Tracker
from gapbridge.bridge.demo.links.link import DemoLink
from gapbridge.bridge.demo.poses import Load
from gapbridge.bridge.demo.rests import Rests, rests
from gapbridge.bridge.demo.result import LoopFigures
from gapbridge.bridge.loop.supervisor import Cause, State
from gapbridge.core.errors import LinkError, RunError
from gapbridge.core.log.mcap_reading import read_columns

Array = NDArray[np.float64]
ATTEMPTS = 8  # a machine that others keep busy may end several runs in a row
SLOWEST = 4  # a machine that cannot keep the cell's rate runs at half of it, or at a fourth
MARGIN = 60.0  # s to connect, arm and end, on top of the trajectory


class Session:
    """Runs of the daemon on one simulated cell, one after the other."""

    def __init__(self, link: DemoLink, folder: Path, tell: Callable[[str], None]) -> None:
        self._link = link
        self._folder = folder
        self._tell = tell
        self._runs: list[RunSummary] = []
        self._slower = 1

    def visit(self, cell: Cell, load: Load, poses: Array) -> Rests:
        """Visit poses (M, n) with a load on the arm; returns what was measured at each.

        The daemon writes setpoints corrected by the cell's model: a cell without compliance is
        one without compensation. A run that breaks off is reported and repeated from home, at half
        the rate where deadlines were missed. Raises RunError where that does not help.
        """
        cell = self._link.declared(cell, load)
        longest = self._link.prepare(self._folder, poses)
        bench = self._link.bench()
        try:
            bench.hang(load)
            for attempt in range(ATTEMPTS):
                if attempt:
                    bench.go(self._link.home)
                try:
                    return self._run(cell, load, poses, longest)
                except (RunError, LinkError) as error:
                    if attempt == ATTEMPTS - 1:
                        raise
                    self._tell(f"  the run broke off ({error}); once more{self._slow(error)}")
            raise AssertionError("unreachable")
        finally:
            bench.close()

    def _slow(self, error: Exception) -> str:
        """Halve the rate from here on where deadlines were missed; return that in words."""
        if Cause.OVERRUN not in str(error) or self._slower >= SLOWEST:
            return ""
        self._slower *= 2
        return f" at {1 / self._slower:g} of the rate, which this machine may keep"

    def _settings(self, cell: Cell) -> DaemonSettings:
        given = settings_of(cell)
        link = given.link.model_copy(update={"rate": given.link.rate / self._slower})
        return given.model_copy(update={"link": link, "uncorrected": True})

    def _run(self, cell: Cell, load: Load, poses: Array, longest: float) -> Rests:
        daemon = Daemon(self._settings(cell), may_write=True)
        over = threading.Event()
        watch = threading.Thread(target=_watch, args=(daemon, over, longest + MARGIN), daemon=True)
        watch.start()
        try:
            with Tracker(self._link.bench()) as tracker, self._link.motion(daemon, poses):
                summary = daemon.run(arm=True)
        finally:
            over.set()
        self._runs.append(summary)
        if summary.faults or summary.recording is None:
            raise RunError(summary.faults[0] if summary.faults else "nothing was recorded")
        recording = read_columns(summary.recording, reported_only=True)
        return rests(recording, tracker.readings(), poses, load, self._link.settling)

    @property
    def written(self) -> int:
        """Return how many setpoints were written so far."""
        return sum(run.setpoints_written for run in self._runs)

    def figures(self) -> LoopFigures:
        """Return how the loop kept time over all runs."""
        cycles, missed = sum(r.cycles for r in self._runs), sum(r.missed for r in self._runs)
        span = sum(r.cycles / r.rate_hz for r in self._runs if r.rate_hz)
        return LoopFigures(
            rate=cycles / span if span else 0.0,
            missed=missed,
            cycles=cycles + missed,
            p99=max((r.age_ms["p99"] for r in self._runs), default=0.0) * 1e3,
        )


def _watch(daemon: Daemon, over: threading.Event, longest: float) -> None:
    """Stop a run that no longer writes: the daemon goes on observing after a fault."""
    began, latest = False, time.monotonic() + longest
    while not over.wait(0.1):
        state = daemon.state
        began |= state == State.COMPENSATING
        if (began and not state.writes) or time.monotonic() > latest:
            daemon.stop()
