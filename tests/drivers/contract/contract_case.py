"""One case of the contract: a driver, and the simulated controller that it talks to."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Self

from patience import wait_for
from ports import own_host

from benchmarks.server_thread import ServerThread
from gapbridge.bridge.cell import load_cell
from gapbridge.core.arm import builtin_arm
from gapbridge.core.model import Model
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.simulated.server.arm_controller import ArmController, make_controller
from gapbridge.drivers.simulated.server.protocol_server import ProtocolServer
from gapbridge.drivers.simulated.ur.settings import simulated_arm

PERIOD = 0.004  # s
CONFIG = Path(__file__).parents[3] / "config"


def model_of(n: int) -> Model:
    """Return a rigid arm of six or seven joints."""
    if n == 6:
        return Model(builtin_arm("ur10e"))
    return load_cell(CONFIG / "seven_axis_urdf.yaml").model


class Case(ABC):
    """A simulated controller served over its wire, and drivers for it.

    resolution: half a count of the joint angles, rad; speed_resolution the same, None where the
    controller does not report speeds; clocked: whether it reports a time of its own, so that a
    clock that stands still can be noticed; torn_shows_within: s after the last whole sample in
    which a torn one is no possible motion (infinite where the wire itself shows it); force: half a
    count of the TCP force, N, None where there is none; writes: ``offset``, ``joints`` or None.
    """

    resolution = 1e-6
    speed_resolution: float | None = 1e-3
    clocked = False
    torn_shows_within = math.inf
    force: float | None = None
    writes: str | None = "joints"
    state_timeout = 0.3
    n = 6

    def __init__(self) -> None:
        self.host = own_host()
        self.model = model_of(self.n)
        self.controller: ArmController = make_controller(
            *simulated_arm(self.model.arm, seed=11), period=PERIOD
        )
        self.servers = self.make_servers()
        self._thread = ServerThread(self.controller, self.servers, self.host)

    @abstractmethod
    def make_servers(self) -> list[ProtocolServer]:
        """Return the servers of the controller at ``host``."""

    @abstractmethod
    def driver(self) -> Driver:
        """Return a driver, not connected."""

    def run_cycles(self, count: int = 5) -> None:
        """Wait until the controller has run so many more cycles."""
        until = self.controller.clock + (count - 0.5) * PERIOD
        wait_for(lambda: self.controller.clock > until, f"{count} cycles of the controller")

    def tear(self) -> None:
        """Have at least one sample that is read next mixed of two moments."""
        raise NotImplementedError

    def start(self) -> None:
        """Serve."""
        self._thread.start()

    def stop(self) -> None:
        """End serving, as a controller that is switched off."""
        self._thread.stop()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
