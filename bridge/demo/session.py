"""The cell during the demo: loads are hung, the daemon runs, the tracker looks on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bridge.cell import Cell
from bridge.daemon import run_daemon, settings_of
from bridge.demo.bench import Bench, Tracker
from bridge.demo.poses import Load
from bridge.demo.rests import Rests, rests
from bridge.demo.result import LoopFigures
from bridge.demo.trajectory import visits, write_trajectory
from bridge.summary import RunSummary
from core.errors import RunError
from core.log import read_log
from drivers.simulated.settings import ServerSettings

Array = NDArray[np.float64]


class Session:
    """Runs of the daemon on one simulated cell, one after the other."""

    def __init__(self, settings: ServerSettings, home: Array, folder: Path) -> None:
        self._settings = settings
        self._home = home
        self._folder = folder
        self._runs: list[RunSummary] = []

    def visit(self, cell: Cell, load: Load, poses: Array) -> Rests:
        """Visit poses (M, n) with a load on the arm; returns what was measured at each.

        The daemon writes setpoints corrected by the cell's model: a cell without compliance is
        one without compensation. Raises RunError where the run fails.
        """
        write_trajectory(self._folder / "trajectory.csv", visits(self._home, poses))
        self._hang(load)
        with Tracker(self._settings) as tracker:
            summary = run_daemon(settings_of(cell), arm=True)
        self._runs.append(summary)
        if summary.faults or summary.recording is None:
            raise RunError(f"the daemon: {'; '.join(summary.faults) or 'recorded nothing'}")
        recording = read_log(summary.recording, cell.arm.n)
        return rests(recording.columns, tracker.readings(), poses)

    def _hang(self, load: Load) -> None:
        bench = Bench(self._settings)
        try:
            bench.hang(load)
        finally:
            bench.close()

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
