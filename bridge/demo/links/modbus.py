"""The demo over Modbus TCP: a UR10e's Modbus server takes offsets that the robot's program applies.

The program moves from pose to pose, with a dwell at each.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np

from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.demo.bench import Bench
from gapbridge.bridge.demo.links.link import DemoLink
from gapbridge.bridge.demo.poses import UR10E, Load, Workspace
from gapbridge.bridge.demo.result import Resolution
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.core.arrays import Array
from gapbridge.core.errors import LinkError
from gapbridge.drivers.modbus.profile import read_profile
from gapbridge.drivers.modbus.registers import UNITS
from gapbridge.drivers.modbus.schema import Mailbox
from gapbridge.drivers.modbus.settings import ModbusSettings
from gapbridge.drivers.simulated.server.arm_controller import OWN_ACCELERATION, OWN_SPEED
from gapbridge.drivers.simulated.ur.settings import BENCH_PORT

PORT = 15020  # below 1024 only root may listen; a real controller's is 502
MAX_START_TIME = 60.0  # s until the daemon writes
RAMP_TIME = 0.8  # s until the offsets are fully applied
DWELL = 0.35  # s at each pose, once the arm is at rest
MAX_VISIT_TIME = 15.0  # s


class ModbusLink(DemoLink):
    """A UR10e that takes offsets in micrometres and reports joints in milliradians.

    The fit uses the joints commanded by the robot's program: one count of the reported joints is
    more than the arm deflects.
    """

    name = "modbus"
    template = "modbus.yaml"
    ports = (PORT, BENCH_PORT)
    settling = 0.3
    reports_joints = False
    experiment = replace(
        UR10E,
        # close poses, since the robot's program moves at 0.5 rad/s; the wrist turns widely, which
        # identifies a bent tool
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
        calibration_poses=11,
    )  # fmt: skip

    def resolution(self) -> Resolution:
        """Return one count of the offset, and one of the reported joints times the reach."""
        link = self.cell.link
        assert isinstance(link, ModbusSettings)
        profile = read_profile(link.profile_path, self.cell.arm.n)
        position = profile.state.position
        assert isinstance(profile.write, Mailbox)
        count = abs(position.scale) * UNITS[position.unit][1]
        return Resolution(
            profile.write.length_count, count * self.cell.model.length,
            "the fit uses the commanded joints, not the measured ones",
        )  # fmt: skip

    def prepare(self, folder: Path, poses: Array) -> float:
        """Return how long the robot's program may take; see DemoLink.prepare."""
        return MAX_VISIT_TIME * (len(poses) + 1)

    def motion(self, daemon: Daemon, poses: Array) -> AbstractContextManager[object]:
        """Run the robot's program while the daemon writes offsets."""
        return RobotProgram(daemon, self.bench, self.home, poses)


def travel_time(start: Array, goal: Array) -> float:
    """Return the duration (s) of the program's joint move, trapezoidal in the leading joint."""
    distance = float(np.abs(goal - start).max())
    if distance < OWN_SPEED**2 / OWN_ACCELERATION:
        return 2.0 * float(np.sqrt(distance / OWN_ACCELERATION))
    return distance / OWN_SPEED + OWN_SPEED / OWN_ACCELERATION


class RobotProgram(threading.Thread):
    """Visits poses as soon as the daemon writes, then stops the daemon."""

    def __init__(
        self, daemon: Daemon, bench: Callable[[], Bench], home: Array, poses: Array
    ) -> None:
        super().__init__(name="robot program", daemon=True)
        self._daemon, self._open_bench, self._home, self._poses = daemon, bench, home, poses
        self._over = threading.Event()
        self._error: LinkError | None = None

    def run(self) -> None:
        """Wait for the daemon, visit the poses and stop the daemon; a fault ends the program."""
        try:
            if self._wait_writing():
                self._visit()
        except LinkError as error:
            self._error = error
        finally:
            self._daemon.stop()

    def _wait_writing(self) -> bool:
        latest = time.monotonic() + MAX_START_TIME
        while time.monotonic() < latest:
            if self._daemon.state == State.COMPENSATING:
                return not self._over.wait(RAMP_TIME)
            if self._over.wait(0.05):
                return False
        return False

    def _visit(self) -> None:
        bench = self._open_bench()
        try:
            here = self._home
            for pose in (*self._poses, self._home):
                if not self._daemon.state.writes:
                    return
                bench.move_to(pose, travel_time(here, pose))
                here = pose
                if self._over.wait(DWELL):
                    return
        finally:
            bench.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, _: object, error: object, *__: object) -> None:
        self._over.set()
        self.join(MAX_VISIT_TIME)
        if self._error is not None and error is None:
            raise self._error
