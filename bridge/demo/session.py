"""Measurement runs of the demo: attach a load, run the daemon, record the tracker."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.run_settings import settings_of
from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.daemon.summary import RunSummary
from gapbridge.bridge.demo.bench import Tracker
from gapbridge.bridge.demo.links.link import DemoLink
from gapbridge.bridge.demo.measurements import (
    Measurements,
    TooFewReadingsError,
    joined,
    measurements_at,
)
from gapbridge.bridge.demo.poses import Load
from gapbridge.bridge.demo.result import LoopFigures
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.core.arrays import Array
from gapbridge.core.errors import LinkError, RunError
from gapbridge.core.log.mcap_reading import read_columns
from gapbridge.drivers.clock import Clock

MAX_SLOWDOWN = 4  # where deadlines are missed the rate is halved, down to this fraction
MARGIN = 60.0  # s to connect, arm and end, in addition to the trajectory
MAX_STALL_TIME = 1200.0  # s for all runs with one load, retries after stalls included
RETRY_PAUSE = 5.0  # s after a run without a completed visit
MAX_TIMER_DELAY = 0.05  # s; a timer later than this means that the machine stalled
STALL_CAUSES = (
    Cause.OVERRUN, Cause.STALE, Cause.RESYNC, Cause.SILENCE, Cause.LINK_LOST, Cause.INEFFECTIVE,
    Cause.WRITE_FAILED, Cause.SOURCE_DRY, Cause.SETPOINT_REFUSED,
)  # fmt: skip
"""What ends a run where a machine stalls; a setpoint is refused where the arm is far behind it."""
MAX_RUNS_WITHOUT_VISIT = 4  # in a row and without a late timer: no stall, a failure


class RunOutcome(NamedTuple):
    """Result of one run: its measurements, and the error that ended it (empty: completed)."""

    measurements: Measurements | None
    error: str
    stalled: bool  # a timer came late during the run
    cause: str = ""  # of the error: a Cause
    few_readings: bool = False  # the tracker measured too rarely


class TimerDelay(threading.Thread):
    """Measures how late timers come on this machine while the ``with`` block lasts."""

    def __init__(self) -> None:
        super().__init__(name="timer delay", daemon=True)
        self._over = threading.Event()
        self.worst = 0.0  # s, largest delay so far

    def run(self) -> None:
        """Wait 5 ms repeatedly and keep the largest delay."""
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
    """Successive runs of the daemon on one simulated cell."""

    def __init__(
        self, link: DemoLink, folder: Path, emit: Callable[[str], None], clock: Clock
    ) -> None:
        self._link = link
        self._folder = folder
        self._emit = emit
        self._clock = clock
        self._runs: list[RunSummary] = []
        self._slower = 1

    def visit(self, cell: Cell, load: Load, poses: Array) -> Measurements:
        """Visit poses (M, n) under a load and return the measurements at each.

        The daemon writes setpoints corrected by the cell's model; without compliance in the cell
        nothing is corrected. A run that ends because this machine stalled is continued from home
        with the remaining visits, at half the rate where deadlines were missed. Raises RunError
        where a run ends for any other reason, or stalls last longer than MAX_STALL_TIME.
        """
        cell = self._link.declared(cell, load)
        latest = self._clock.monotonic() + MAX_STALL_TIME
        parts: list[Measurements] = []
        remaining, runs_without_visit = poses, 0
        longest = self._link.prepare(self._folder, remaining)
        bench = self._link.bench()
        try:
            bench.attach(load)
            while True:
                outcome = self._run(cell, load, remaining, longest)
                if progress := outcome.measurements is not None:
                    parts.append(outcome.measurements)
                    remaining = remaining[len(outcome.measurements) :]
                runs_without_visit = 0 if progress or outcome.stalled else runs_without_visit + 1
                if outcome.error or len(remaining):
                    self._check_outcome(outcome, runs_without_visit, latest)
                    self._emit(
                        f"  this machine stalled ({outcome.error}); "
                        f"{len(poses) - len(remaining)} of {len(poses)} visits done, "
                        f"continuing{self._slow_down(outcome.cause)}"
                    )
                    self._clock.sleep(0.0 if progress else RETRY_PAUSE)
                    bench.move_to(self._link.home)  # the next run begins there
                if not len(remaining):
                    return parts[0] if len(parts) == 1 else joined(parts)
                longest = self._link.prepare(self._folder, remaining)
        finally:
            bench.close()

    def _check_outcome(self, outcome: RunOutcome, runs_without_visit: int, latest: float) -> None:
        """Raise RunError where no stall ended the run, or stalls last too long."""
        retry = outcome.few_readings or outcome.cause in STALL_CAUSES
        retry = retry and runs_without_visit < MAX_RUNS_WITHOUT_VISIT
        if not (outcome.stalled or retry):
            raise RunError(outcome.error or "the run ended before its last visit")
        if self._clock.monotonic() > latest:
            raise RunError(f"stalled for more than {MAX_STALL_TIME:g} s: {outcome.error}")

    def _slow_down(self, cause: str) -> str:
        """Halve the rate of later runs where deadlines were missed; return the message for it."""
        if cause != Cause.OVERRUN or self._slower >= MAX_SLOWDOWN:
            return ""
        self._slower *= 2
        return f" at {1 / self._slower:g} of the rate"

    def _settings(self, cell: Cell) -> DaemonSettings:
        settings = settings_of(cell)
        link = settings.link.model_copy(update={"rate": settings.link.rate / self._slower})
        return settings.model_copy(update={"link": link, "uncorrected": True})

    def _run(self, cell: Cell, load: Load, poses: Array, longest: float) -> RunOutcome:
        """Run the daemon through the poses until the end or the first error."""
        daemon = Daemon(self._settings(cell), True, self._clock)
        over = threading.Event()
        watch = threading.Thread(target=_watch, args=(daemon, over, longest + MARGIN), daemon=True)
        watch.start()
        summary, error = None, ""
        with TimerDelay() as timer:
            try:
                with Tracker(self._link.bench()) as tracker, self._link.motion(daemon, poses):
                    summary = daemon.run(arm=True)
                readings = tracker.readings()
            except LinkError as link_error:
                error = str(link_error)
            finally:
                over.set()
        stalled = timer.worst > MAX_TIMER_DELAY
        if summary is not None:
            self._runs.append(summary)
        if summary is None or error or summary.recording is None:
            return RunOutcome(None, error or "nothing was recorded", stalled)
        recording = {
            name: values
            for name, values in read_columns(summary.recording).items()
            if not np.isnan(values).all()  # NaN throughout: the controller does not report it
        }
        measured, missing = measurements_at(recording, readings, poses, load, self._link.settling)
        if summary.faults:
            return RunOutcome(measured, summary.faults[0], stalled, summary.cause)
        few = isinstance(missing, TooFewReadingsError)
        return RunOutcome(measured, str(missing or ""), stalled, few_readings=few)

    @property
    def written(self) -> int:
        """Return how many setpoints were written so far."""
        return sum(run.setpoints_written for run in self._runs)

    def figures(self) -> LoopFigures:
        """Return how the loop kept time over all runs."""
        cycles, missed = sum(r.cycles for r in self._runs), sum(r.missed for r in self._runs)
        span = sum(r.cycles / r.rate_hz for r in self._runs if r.rate_hz)
        writing = [r for r in self._runs if r.setpoints_written]  # others: ages of what was read
        return LoopFigures(
            rate=cycles / span if span else 0.0,
            missed=missed,
            cycles=cycles + missed,
            p99=max((r.age_ms["p99"] for r in writing), default=0.0) * 1e3,
        )


def _watch(daemon: Daemon, over: threading.Event, longest: float) -> None:
    """Stop a run that no longer writes: after a fault the daemon would keep observing."""
    began, latest = False, time.monotonic() + longest
    while not over.wait(0.1):
        state = daemon.state
        began |= state == State.COMPENSATING
        if (began and not state.writes) or time.monotonic() > latest:
            daemon.stop()
