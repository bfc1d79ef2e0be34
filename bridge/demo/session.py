"""The cell during the demo: loads are hung, the daemon runs, the tracker looks on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Self

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.daemon.daemon import Daemon, settings_of
from gapbridge.bridge.daemon.summary import RunSummary
from gapbridge.bridge.demo.bench import Tracker
from gapbridge.bridge.demo.links.link import DemoLink
from gapbridge.bridge.demo.poses import Load
from gapbridge.bridge.demo.rests import FEW_READINGS, Rests, joined, rests_so_far
from gapbridge.bridge.demo.result import LoopFigures
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.core.arrays import Array
from gapbridge.core.errors import LinkError, RunError
from gapbridge.core.log.mcap_reading import read_columns
from gapbridge.drivers.clock import SYSTEM, Clock

SLOWEST = 4  # a machine that cannot keep the cell's rate runs at half of it, or at a fourth
MARGIN = 60.0  # s to connect, arm and end, on top of the trajectory
PATIENCE = 1200.0  # s that a machine which stalls may take longer over one load
PAUSE = 5.0  # s after a run in which a stalled machine came no farther
STALL = 0.05  # s that a timer of this process comes late: the machine stood still
STALLED = (
    Cause.OVERRUN, Cause.STALE, Cause.RESYNC, Cause.SILENCE, Cause.LINK_LOST, Cause.INEFFECTIVE,
    Cause.WRITE_FAILED, Cause.SOURCE_DRY, "limits.following",
    FEW_READINGS,
)  # fmt: skip
"""Why a run ends on a machine that stands still: deadlines, and an arm that was left behind."""
FRUITLESS = 4  # runs in a row without a visit, and no timer late: that is no machine standing still


class Ended(NamedTuple):
    """How far a run came: the rests up to there, and why it broke off; empty: it did not."""

    found: Rests | None
    broke: str
    stalled: bool  # the machine stood still meanwhile


class Lateness(threading.Thread):
    """Sees whether this machine stands still while the ``with`` block lasts."""

    def __init__(self) -> None:
        super().__init__(name="lateness", daemon=True)
        self._over = threading.Event()
        self.worst = 0.0  # s

    def run(self) -> None:
        """Wait for short times, and see how much longer it takes."""
        before = time.monotonic()
        while not self._over.wait(0.005):
            now = time.monotonic()
            self.worst, before = max(self.worst, now - before - 0.005), now

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self.join(5)


class Session:
    """Runs of the daemon on one simulated cell, one after the other."""

    def __init__(
        self, link: DemoLink, folder: Path, emit: Callable[[str], None], clock: Clock = SYSTEM
    ) -> None:
        self._link = link
        self._folder = folder
        self._emit = emit
        self._clock = clock
        self._runs: list[RunSummary] = []
        self._slower = 1

    def visit(self, cell: Cell, load: Load, poses: Array) -> Rests:
        """Visit poses (M, n) with a load on the arm; returns what was measured at each.

        The daemon writes setpoints corrected by the cell's model: a cell without compliance is
        one without compensation. There is one try: a run that breaks off because this machine
        stood still goes on from home with the visits that are left, at half the rate where
        deadlines were missed. Raises RunError where a run breaks off for any other reason, or the
        machine stalls for longer than PATIENCE.
        """
        cell = self._link.declared(cell, load)
        latest = self._clock.monotonic() + PATIENCE
        parts: list[Rests] = []
        left, fruitless = poses, 0
        longest = self._link.prepare(self._folder, left)
        bench = self._link.bench()
        try:
            bench.hang(load)
            while True:
                ended = self._run(cell, load, left, longest)
                if ended.found is not None:
                    parts.append(ended.found)
                    left = left[len(ended.found) :]
                fruitless = 0 if ended.found is not None or ended.stalled else fruitless + 1
                if ended.broke or len(left):
                    self._require_stall(ended, fruitless, latest)
                    self._emit(
                        f"  this machine stood still ({ended.broke}); {len(poses) - len(left)} of "
                        f"{len(poses)} visits are done, going on{self._slow(ended.broke)}"
                    )
                    self._clock.sleep(0.0 if ended.found is not None else PAUSE)
                    bench.go(self._link.home)  # the next run begins there
                if not len(left):
                    return parts[0] if len(parts) == 1 else joined(parts)
                longest = self._link.prepare(self._folder, left)
        finally:
            bench.close()

    def _require_stall(self, ended: Ended, fruitless: int, latest: float) -> None:
        """Raise RunError where a run has not broken off for a stalled machine, or too late."""
        known = fruitless < FRUITLESS and any(cause in ended.broke for cause in STALLED)
        if not (ended.stalled or known):
            raise RunError(ended.broke or "the run ended before its last visit")
        if self._clock.monotonic() > latest:
            raise RunError(f"this machine stalled for {PATIENCE:g} s and more: {ended.broke}")

    def _slow(self, broke: str) -> str:
        """Halve the rate from here on where deadlines were missed; return that in words."""
        if Cause.OVERRUN not in broke or self._slower >= SLOWEST:
            return ""
        self._slower *= 2
        return f" at {1 / self._slower:g} of the rate, which this machine may keep"

    def _settings(self, cell: Cell) -> DaemonSettings:
        given = settings_of(cell)
        link = given.link.model_copy(update={"rate": given.link.rate / self._slower})
        return given.model_copy(update={"link": link, "uncorrected": True})

    def _run(self, cell: Cell, load: Load, poses: Array, longest: float) -> Ended:
        """Run the daemon through the poses, or as far as it comes."""
        daemon = Daemon(self._settings(cell), may_write=True)
        over = threading.Event()
        watch = threading.Thread(target=_watch, args=(daemon, over, longest + MARGIN), daemon=True)
        watch.start()
        summary, broke = None, ""
        with Lateness() as late:
            try:
                with Tracker(self._link.bench()) as tracker, self._link.motion(daemon, poses):
                    summary = daemon.run(arm=True)
                readings = tracker.readings()
            except LinkError as error:
                broke = str(error)
            finally:
                over.set()
        stalled = late.worst > STALL
        if summary is not None:
            self._runs.append(summary)
        if summary is None or broke or summary.recording is None:
            return Ended(None, broke or "nothing was recorded", stalled)
        recording = read_columns(summary.recording, reported_only=True)
        found, missing = rests_so_far(recording, readings, poses, load, self._link.settling)
        return Ended(found, summary.faults[0] if summary.faults else missing, stalled)

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
