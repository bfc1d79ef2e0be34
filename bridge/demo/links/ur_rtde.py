"""The demo over RTDE: a UR10e moved by setpoints; the controller reports payload and force."""

from __future__ import annotations

from pathlib import Path

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.demo.bench import Bench, UrBench
from gapbridge.bridge.demo.links.link import DemoLink
from gapbridge.bridge.demo.poses import UR10E, Load
from gapbridge.bridge.demo.result import Resolution
from gapbridge.bridge.demo.trajectory import PERIOD, visit_trajectory
from gapbridge.bridge.setpoint_source.quintic import write_trajectory
from gapbridge.core.arrays import Array
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
    experiment = UR10E
    effect_choices = ("bent_tool", "shifted_zero")

    def bench(self) -> Bench:
        """Return a connection to the bench that also sends URScript."""
        return UrBench(self.host)

    def declared(self, cell: Cell, load: Load) -> Cell:
        """Return the cell unchanged: the controller itself reports the load."""
        return cell

    def resolution(self) -> Resolution:
        """Return zeros: joints are 64-bit floats in both directions."""
        return Resolution(0.0, 0.0)

    def prepare(self, folder: Path, poses: Array) -> float:
        """Write the trajectory that the daemon follows; see DemoLink.prepare."""
        q = visit_trajectory(self.home, poses, self.cell.arm.limits.velocity)
        return write_trajectory(folder / "trajectory.csv", q, PERIOD)
