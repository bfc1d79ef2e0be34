"""A simulated PiPER on python-can's virtual bus, and frames as its manual has them."""

from __future__ import annotations

import itertools
import math
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import can
import numpy as np
from patience import PATIENCE

from benchmarks.server_thread import ServerThread
from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import InvalidStateError, StaleStateError
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.can.driver import CanDriver
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.simulated.can.nodes import CanNodes
from gapbridge.drivers.simulated.can.server import make_servers
from gapbridge.drivers.simulated.server.arm_controller import ArmController, make_controller
from gapbridge.drivers.simulated.ur.settings import simulated_arm

_channels = itertools.count()
UNIT = math.radians(0.001)
MODEL = Model(builtin_arm("ur10e"))


class Served(NamedTuple):
    controller: ArmController
    nodes: CanNodes
    settings: CanSettings
    driver: CanDriver


@contextmanager
def served_arm(profile: str = "piper", **keys: object) -> Iterator[Served]:
    """Serve an arm and give a driver for it, not connected."""
    channel = f"faults{next(_channels)}"
    given = {"foreign_quiet": 0.2, "state_timeout": 1.0, **keys}
    settings = CanSettings(profile=profile, interface="virtual", channel=channel, **given)
    controller = make_controller(*simulated_arm(MODEL.arm, seed=5), period=0.004)
    (nodes,) = make_servers(settings, "127.0.0.2", controller)
    with ServerThread(controller, [nodes], "127.0.0.2"):
        driver = CanDriver(settings, MODEL, clock=SYSTEM)
        try:
            yield Served(controller, nodes, settings, driver)
        finally:
            driver.close()


def next_state(driver: CanDriver) -> RobotState:
    """Return the next sample; on a busy machine torn ones, and late ones, come before."""
    until = time.monotonic() + PATIENCE
    while True:
        try:
            return driver.read_state()
        except (InvalidStateError, StaleStateError):
            if time.monotonic() > until:
                raise


def joints_frame(first: int, a: float, b: float) -> tuple[int, bytes]:
    """Return a PiPER's joint feedback of two joints (rad), the first of them from 1."""
    return 0x2A5 + (first - 1) // 2, struct.pack(">ii", round(a / UNIT), round(b / UNIT))


def setpoint_of(q) -> Setpoint:
    return Setpoint(q, q, np.zeros(6))


def other_bus(settings: CanSettings) -> can.BusABC:
    return can.Bus(interface="virtual", channel=settings.channel)
