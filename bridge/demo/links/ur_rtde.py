"""UR over RTDE: setpoints move the arm; the controller reports payload and force."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.bridge.cell.simulation import server_settings
from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.demo.bench import Bench, UrBench
from gapbridge.bridge.demo.links.link import DemoLink
from gapbridge.bridge.demo.poses import UR10E
from gapbridge.bridge.demo.result import Resolution
from gapbridge.bridge.demo.trajectory import visits, write_trajectory
from gapbridge.core.arrays import Array
from gapbridge.drivers.simulated.ur.process import SimulatedController
from gapbridge.drivers.simulated.ur.settings import (
    BENCH_PORT,
    DASHBOARD_PORT,
    PRIMARY_PORT,
    RTDE_PORT,
    SCRIPT_PORT,
)


class UrRtdeLink(DemoLink):
    """A UR10e."""

    name = "ur_rtde"
    template = "cell.yaml"
    ports = (RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT, PRIMARY_PORT, BENCH_PORT)
    scene = UR10E

    def __init__(self, out: Path, seed: int) -> None:
        super().__init__(out, seed)
        settings = server_settings(self.cell, seed=seed)
        hidden: dict[str, Any] = dict(self.hidden.simulation)
        self._settings = replace(settings, plant=replace(settings.plant, **hidden))
        self._folder = out

    @property
    def home(self) -> Array:
        """Return where the arm stands at the start (6,), rad."""
        return np.array(self._settings.start_q)

    def served(self) -> AbstractContextManager[object]:
        """Serve the simulated controller in a process of its own. Raises LinkError."""
        return SimulatedController(self._settings)

    def bench(self) -> Bench:
        """Return a connection to the bench, with the pendant."""
        return UrBench(self._settings)

    def resolution(self) -> Resolution:
        """Return nothing: joints go both ways as 64-bit floats."""
        return Resolution(0.0, 0.0)

    def prepare(self, folder: Path, poses: Array) -> float:
        """Write the trajectory that the daemon follows; see DemoLink.prepare."""
        return write_trajectory(
            folder / "trajectory.csv", visits(self.home, poses, self.cell.arm.limits.velocity)
        )

    def motion(self, daemon: Daemon, poses: Array) -> AbstractContextManager[object]:
        """Do nothing: the daemon's setpoints move the arm."""
        return nullcontext()
