"""The demo on CAN: an AgileX PiPER with flexible joints and yielding servos, moved by setpoints."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gapbridge.bridge.demo.hidden import yielding_servos
from gapbridge.bridge.demo.links.link import DemoLink
from gapbridge.bridge.demo.poses import Experiment, Load, Workspace
from gapbridge.bridge.demo.result import Resolution
from gapbridge.bridge.demo.trajectory import PERIOD, visit_trajectory
from gapbridge.bridge.setpoint_source.quintic import write_trajectory
from gapbridge.core.arrays import Array
from gapbridge.drivers.can.loading import read_profile
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.can_bus.bus import SOCKETCAND_PORT
from gapbridge.drivers.simulated.plant.plant_arm import plant_arm
from gapbridge.drivers.simulated.plant.plant_settings import draw_plant_settings
from gapbridge.drivers.simulated.ur.settings import BENCH_PORT

SOFTNESS = 40.0
"""Factor on the drawn flexibilities, which are those of an arm of a UR's size. The PiPER's joints
then have 1 to 10 kNm/rad about their axes, plausible for small planetary gears, and the TCP sags by
1 to 3 mm under 1.4 kg (rated payload 1.5 kg). Its repeatability is the plant's, 0.05 mm."""

TOP_SPEED = 2.0  # rad/s; at higher speeds the following error exceeds limits.following

HOLDING_TORQUE = (0.0, 15.0, 8.9, 1.9, 2.6, 0.0)
"""Largest holding torques of the joints, Nm, at the measured poses with 1.5 kg."""


class CanLink(DemoLink):
    """A PiPER on a virtual CAN bus between processes (socketcand protocol)."""

    name = "can"
    template = "can.yaml"
    files = ("piper.urdf",)
    ports = (SOCKETCAND_PORT, BENCH_PORT)
    experiment = Experiment(
        workspace=Workspace(
            lower=(-0.6, 1.0, -2.0, -1.0, 0.0, -1.6), upper=(0.6, 2.3, -0.6, 1.0, 1.1, 1.6),
            lowest=0.05, nearest=0.22, far=0.35, regular=0.02,
        ),
        calibration_loads=(
            Load("0.5 kg", 0.5),
            Load("1.5 kg", 1.5, (0.0, 0.0, 0.08)),
            Load("1 kg at the side", 1.0, (0.06, 0.03, 0.07)),
        ),
        test_loads=(
            Load("1.4 kg", 1.4, (0.01, 0.0, 0.09)),
            Load("1.2 kg at the side", 1.2, (-0.04, 0.03, 0.07)),
        ),
        calibration_poses=13, test_poses=2,
    )  # fmt: skip

    def __init__(self, out: Path, seed: int) -> None:
        super().__init__(out, seed)
        self.hidden = self.hidden.combined(yielding_servos(seed, HOLDING_TORQUE))

    def _simulation_lines(self) -> str:
        """Return the arm's flexibilities, drawn from the seed, as a line of the cell."""
        drawn = draw_plant_settings(plant_arm(self.cell.arm), self.seed)
        axial, radial = (
            ", ".join(f"{SOFTNESS * v:.9e}" for v in values)
            for values in (drawn.axial, drawn.radial)
        )
        return f"  compliance: {{axial: [{axial}], radial: [{radial}]}}\n"

    def resolution(self) -> Resolution:
        """Return one count of the joint frames (0.001 deg) times the reach, written and read."""
        link = self.cell.link
        assert isinstance(link, CanSettings)
        joints = read_profile(link.profile_path, link.installation).joints
        assert joints.resolution is not None
        length = self.cell.model.length
        count = float(np.abs(joints.resolution).max()) * length
        return Resolution(count, count, "finer than the arm's repeatability")

    def prepare(self, folder: Path, poses: Array) -> float:
        """Write the trajectory that the daemon follows; see DemoLink.prepare."""
        top_speed = np.minimum(self.cell.arm.limits.velocity, TOP_SPEED)
        q = visit_trajectory(self.home, poses, top_speed)
        return write_trajectory(folder / "trajectory.csv", q, PERIOD)
