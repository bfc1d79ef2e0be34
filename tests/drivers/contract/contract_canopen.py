"""Cases of the contract: every CANopen profile that is shipped, over its wires."""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from contract_case import Case
from patient_drives import patient

from gapbridge.drivers.canopen.driver import CanopenDriver
from gapbridge.drivers.canopen.settings import CanopenSettings
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.simulated.canopen.server import CanopenServer, make_servers
from gapbridge.drivers.simulated.server.protocol_server import ProtocolServer

PORT = 29900  # each case has an address of its own
LATE = 0.012  # s that a torn sample's PDO is late: it comes after the next SYNC's slot
_channels = itertools.count()


class CanopenCase(Case):
    """Drives on a bus: their profile, their wire, half a count of the coarsest joint.

    ``speed`` None: the drives report none in a known unit, and positions of a plant that a busy
    machine moves in bursts show it badly.
    """

    def __init__(
        self, profile: str, interface: str, resolution: float, speed: float | None
    ) -> None:
        self.resolution, self.speed_resolution = resolution + 1e-9, speed
        self._folder = tempfile.TemporaryDirectory(prefix="contract-")
        self.settings = CanopenSettings(
            profile=patient(profile, Path(self._folder.name)), interface=interface,
            channel=f"contract{next(_channels)}", port=PORT, rate=100.0,
            state_timeout=self.state_timeout, listen=0.05, foreign_quiet=0.2,
            sdo_timeout=5.0,  # of a busy machine
        )  # fmt: skip
        super().__init__()
        self.settings = self.settings.model_copy(update={"host": self.host})

    def make_servers(self) -> list[ProtocolServer]:
        """Return the drives."""
        return make_servers(self.settings, self.host, self.controller)

    def driver(self) -> Driver:
        """Return a CANopen driver."""
        return CanopenDriver(self.settings, self.model, clock=SYSTEM)

    def tear(self) -> None:
        """Have one drive's PDOs, off by 0.05 rad, come so late that they meet the next SYNC's."""
        server = self.servers[0]
        assert isinstance(server, CanopenServer)
        server.delay_tpdos(server.profile.nodes[1], LATE, 2)


def canopen_cases() -> dict[str, Callable[[], Case]]:
    """Return a maker of each case by its name."""
    thousandth = 0.5 * math.radians(0.001)
    fine = math.pi / (131072 * 51)
    return {
        "canopen cia402, virtual": partial(CanopenCase, "cia402", "virtual", fine, 1e-3),
        "canopen lwa4p, virtual": partial(CanopenCase, "lwa4p", "virtual", thousandth, None),
        "canopen lwa4p, socketcand": partial(CanopenCase, "lwa4p", "socketcand", thousandth, None),
    }
