"""Modbus: a UR10e's own server; the robot's program moves the arm, offsets ride on it."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.demo.links.link import DemoLink
from gapbridge.bridge.demo.own_program import LONGEST_VISIT, OwnProgram
from gapbridge.bridge.demo.poses import UR10E, Load, Workspace
from gapbridge.bridge.demo.result import Resolution, reach
from gapbridge.core.arrays import Array
from gapbridge.drivers.modbus.profile import read_profile
from gapbridge.drivers.modbus.registers import UNITS
from gapbridge.drivers.modbus.schema import Mailbox
from gapbridge.drivers.modbus.settings import ModbusSettings
from gapbridge.drivers.simulated.ur.settings import BENCH_PORT

PORT = 15020  # below 1024 only root may listen; a real controller's is 502


class ModbusLink(DemoLink):
    """A UR10e whose mailbox takes offsets in micrometres, and whose joints read in milliradians.

    The program that moves the arm is the user's own, who knows where it was sent: the fit takes
    those joints, since one count of what is read is more than the arm bends.
    """

    name = "modbus"
    template = "modbus.yaml"
    ports = (PORT, BENCH_PORT)
    settling = 0.3
    reports_joints = False
    scene = replace(
        UR10E,
        # near to each other, as the robot's own program moves at 0.5 rad/s, but for the wrist: what
        # is bent in the tool turns with it
        workspace=Workspace(
            lower=(-0.3, -1.7, 1.4, -2.2, -2.1, -0.7), upper=(0.3, -1.2, 2.0, -1.5, -1.05, 0.7),
            lowest=0.15, nearest=0.35, far=0.6, regular=0.05,
        ),
        calibration_loads=(
            Load("5 kg at the side", 5.0, (0.06, 0.04, 0.06)),
            Load("12 kg", 12.0),
        ),
        test_loads=(
            Load("12 kg and off", 12.0, (0.01, 0.0, 0.08)),
            Load("8 kg", 8.0, (0.0, 0.02, 0.07)),
        ),
        calibrate=11,
    )  # fmt: skip

    def resolution(self) -> Resolution:
        """Return one count of the offset, and one of the joints as read times the reach."""
        link = self.cell.link
        assert isinstance(link, ModbusSettings)
        profile = read_profile(link.profile_path, self.cell.arm.n)
        position = profile.state.position
        assert isinstance(profile.write, Mailbox)
        count = abs(position.scale) * UNITS[position.unit][1]
        return Resolution(
            profile.write.length_count, count * reach(self.cell.model),
            "the fit takes the joints that the robot's program was sent to, not those read",
        )  # fmt: skip

    def prepare(self, folder: Path, poses: Array) -> float:
        """Return how long the robot's program may take; see DemoLink.prepare."""
        return LONGEST_VISIT * (len(poses) + 1)

    def motion(self, daemon: Daemon, poses: Array) -> AbstractContextManager[object]:
        """Run the robot's own program while the daemon rides on it."""
        return OwnProgram(daemon, self.bench, self.home, poses)
