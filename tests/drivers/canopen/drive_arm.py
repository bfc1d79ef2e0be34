"""An arm of simulated CiA 402 drives on a bus in this process, and drivers for it."""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import can
import numpy as np
from patience import PATIENCE
from patient_drives import patient

from benchmarks.server_thread import ServerThread
from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import InvalidStateError, LinkError
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.canopen.driver import CanopenDriver
from gapbridge.drivers.canopen.settings import CanopenSettings
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.simulated.canopen.machine import Phase
from gapbridge.drivers.simulated.canopen.server import CanopenServer
from gapbridge.drivers.simulated.server.arm_controller import ArmController, make_controller
from gapbridge.drivers.simulated.ur.settings import simulated_arm

HOST = "127.0.0.1"
_numbers = itertools.count()


class DriveArm:
    """Six drives behind a profile, on python-can's virtual bus.

    ``is_patient``: heartbeats may be seconds late, where the profile is a shipped one.
    """

    def __init__(self, profile: str = "cia402", is_patient: bool = True, **keys: Any) -> None:
        chosen = {
            "interface": "virtual", "channel": f"drives{next(_numbers)}", "rate": 100.0,
            "state_timeout": 0.3, "listen": 0.05, "foreign_quiet": 0.1,
            "sdo_timeout": 5.0,  # of a busy machine
        }  # fmt: skip
        if is_patient and not profile.endswith(".yaml"):
            self._folder = tempfile.TemporaryDirectory(prefix="drives-")
            profile = patient(profile, Path(self._folder.name))
        self.settings = CanopenSettings(profile=profile, **{**chosen, **keys})
        self.model = Model(builtin_arm("ur10e"))
        self.controller: ArmController = make_controller(
            *simulated_arm(self.model.arm, seed=3), period=0.004
        )
        self.server = CanopenServer(self.settings, HOST, self.controller)
        self.thread = ServerThread(self.controller, [self.server], HOST)

    def driver(self, **keys: Any) -> CanopenDriver:
        """Return a driver, not connected."""
        return CanopenDriver(self.settings.model_copy(update=keys), self.model, clock=SYSTEM)

    @contextmanager
    def other_bus(self) -> Iterator[can.BusABC]:
        """Yield somebody else's access to the bus."""
        bus = can.Bus(interface="virtual", channel=self.settings.channel)
        try:
            yield bus
        finally:
            bus.shutdown()


@contextmanager
def served(profile: str = "cia402", **keys: Any) -> Iterator[DriveArm]:
    """Serve an arm while the block lasts; see DriveArm."""
    arm = DriveArm(profile, **keys)
    with arm.thread:
        yield arm


def phases(arm: DriveArm) -> set[Phase]:
    """Return the phases in which the drives are."""
    return {drive.axis.machine.phase for drive in arm.server.drives}


def settled(driver: CanopenDriver, seconds: float = PATIENCE) -> RobotState:
    """Return a state; a machine that is busy may tear a set or two."""
    until = time.monotonic() + seconds
    while True:
        try:
            return driver.read_state()
        except LinkError:
            if time.monotonic() > until:
                raise


def read_on(driver: CanopenDriver, cycles: int = 200) -> None:
    """Read so many cycles, past torn samples; raises what the driver raises otherwise."""
    for _ in range(cycles):
        with suppress(InvalidStateError):
            driver.read_state()


def setpoint(q: np.ndarray, state: RobotState) -> Setpoint:
    """Return a setpoint as the limiter hands it on."""
    return Setpoint(q, q, np.zeros(6))


def follow(
    driver: CanopenDriver,
    goal: np.ndarray,
    controller: ArmController,
    within: float = 1e-4,
    seconds: float = PATIENCE,
) -> None:
    """Lead the arm to joints at 0.2 rad/s."""
    start, begun = np.array(controller.q), time.monotonic()
    way = float(np.abs(goal - start).max())
    while np.abs(goal - controller.q).max() > within:
        assert time.monotonic() - begun < seconds, f"not there: {goal - controller.q}"
        state = settled(driver)
        share = min((time.monotonic() - begun) * 0.2 / way, 1.0)
        driver.write_setpoint(setpoint(start + share * (goal - start), state))
