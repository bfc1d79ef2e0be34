"""Cases of the contract: every CAN profile that is shipped, on every wire, and an invented one."""

from __future__ import annotations

import itertools
import math
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from contract_case import Case

from gapbridge.drivers.can.driver import CanDriver
from gapbridge.drivers.can.loading import read_profile
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.simulated.can.nodes import CanNodes
from gapbridge.drivers.simulated.can.server import make_servers
from gapbridge.drivers.simulated.server.protocol_server import ProtocolServer

INVENTED = Path(__file__).parents[1] / "can" / "invented.yaml"
PORT = 29600  # each case has an address of its own
_channels = itertools.count()
THOUSANDTH = math.radians(0.001)


@dataclass(frozen=True)
class CanArm:
    """An arm on a bus: its profile, half a count of its joints (rad), the ids of two frames."""

    profile: str
    resolution: float  # rad
    frames: tuple[int, int]
    n: int = 6  # joints
    speed: float | None = 1e-3  # rad/s, half a count; None: it reports none
    gear: float | None = None  # wire turns per joint turn; None: the profile's

    @property
    def gears(self) -> tuple[float, ...] | None:
        """Return the gear of each joint, every other one with the opposite sign."""
        gear = self.gear
        return None if gear is None else tuple(gear * (-1) ** i for i in range(self.n))


class CanCase(Case):
    """An arm on a bus of one of python-can's interfaces."""

    def __init__(self, arm: CanArm, interface: str, rate: float = 100.0) -> None:
        number = next(_channels)
        channel = f"bus{number}"
        if interface == "slcan":
            channel = f"{tempfile.gettempdir()}/gapbridge-{os.getpid()}-{number}"
        self.n, self.resolution, self.speed_resolution = arm.n, arm.resolution + 1e-9, arm.speed
        self._frames = arm.frames
        self.settings = CanSettings(
            profile=arm.profile, interface=interface, channel=channel, port=PORT, rate=rate,
            state_timeout=self.state_timeout, foreign_quiet=0.2, gear=arm.gears,
        )  # fmt: skip
        super().__init__()
        # both ends of the pty are in this busy process: a frame may take longer than a cell allows
        changes = {"host": self.host, "send_timeout": 10.0}
        profile = read_profile(self.settings.profile_path, self.settings.installation)
        if not (profile.ordered or profile.counted):  # else two cycles in one burst are like one
            self.torn_shows_within = 3.0 / rate
        self.settings = self.settings.model_copy(update=changes)

    def make_servers(self) -> list[ProtocolServer]:
        """Return the arm's nodes."""
        return make_servers(self.settings, self.host, self.controller)

    def driver(self) -> Driver:
        """Return a CAN driver."""
        return CanDriver(self.settings, self.model, clock=SYSTEM)

    def tear(self) -> None:
        """Have two samples lose a frame each, so that what is left looks like one."""
        nodes = self.servers[0]
        assert isinstance(nodes, CanNodes)
        nodes.tear(*self._frames)


def can_cases() -> dict[str, Callable[[], Case]]:
    """Return a maker of each case by its name."""
    piper = CanArm("piper", 0.5 * THOUSANDTH, (0x2A5, 0x2A6))
    openarm = CanArm("openarm", 12.5 / 65535, (0x11, 0x12), n=7, speed=0.012)
    odrive = CanArm("odrive", 2.0 * math.pi * 2e-7, (0x09, 0x29), gear=9.0)
    invented = CanArm(str(INVENTED), 0.25 * THOUSANDTH, (0x18FF5010, 0x18FF5011), speed=None)
    return {
        "can piper, virtual": partial(CanCase, piper, "virtual"),
        "can piper, socketcand": partial(CanCase, piper, "socketcand", rate=200.0),
        "can piper, slcan": partial(CanCase, piper, "slcan"),
        "can openarm, socketcand": partial(CanCase, openarm, "socketcand"),
        "can odrive, virtual": partial(CanCase, odrive, "virtual"),
        "can, a map that no code knows": partial(CanCase, invented, "socketcand"),
    }
