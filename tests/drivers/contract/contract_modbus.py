"""Cases of the contract: every Modbus profile that is shipped, and one that no code knows."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

from contract_case import Case

from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.modbus.driver import ModbusDriver
from gapbridge.drivers.modbus.profile import read_profile
from gapbridge.drivers.modbus.registers import UNITS
from gapbridge.drivers.modbus.schema import Mailbox, Vector
from gapbridge.drivers.modbus.settings import ModbusSettings
from gapbridge.drivers.simulated.modbus.server import TORN_APART, ModbusServer
from gapbridge.drivers.simulated.server.protocol_server import ProtocolServer
from gapbridge.drivers.state_check import VELOCITY_FACTOR

INVENTED = Path(__file__).parents[1] / "modbus" / "invented.yaml"
PORT = 15100  # each case has an address of its own


def _half_a_count(entry: Vector | None) -> float | None:
    if entry is None:
        return None
    count = abs(entry.scale) * UNITS[entry.unit][1]
    return 1e-6 if entry.type.startswith("f") else 0.5 * count


class ModbusCase(Case):
    """A controller with a profile's register map.

    ``watchdog``: s that the robot's program waits for a heartbeat; None: as the profile says. A
    busy machine may write later than that, which is no fault of the driver.
    """

    def __init__(self, profile: str, watchdog: float | None = 10.0) -> None:
        self.settings = ModbusSettings(profile=profile, port=PORT, rate=50.0, timeout=1.0)
        self.file = file = read_profile(self.settings.profile_path)
        self.robot_file = file
        if watchdog is not None and isinstance(file.write, Mailbox):
            box = file.write.model_copy(update={"watchdog": watchdog})
            self.robot_file = file.model_copy(update={"write": box})
        self.n = file.joints
        self.resolution = (_half_a_count(file.state.position) or 0.0) + 1e-9
        self.speed_resolution = _half_a_count(file.state.velocity)
        self.force = _half_a_count(file.state.force)
        self.clocked = file.clock is not None
        mode = file.write.mode
        self.writes = {"mailbox": "offset", "target_trigger": "joints"}.get(mode)
        super().__init__()
        if file.clock is None or file.clock.again is None:
            fastest = VELOCITY_FACTOR * float(self.model.arm.limits.velocity.max())
            self.torn_shows_within = TORN_APART / fastest
        self.settings = self.settings.model_copy(update={"host": self.host})

    def make_servers(self) -> list[ProtocolServer]:
        """Return the Modbus server."""
        return [ModbusServer(self.robot_file, self.host, self.settings.port or self.file.port)]

    def driver(self) -> Driver:
        """Return a Modbus driver."""
        return ModbusDriver(self.settings, self.model, clock=SYSTEM)

    def tear(self) -> None:
        """Have images mixed of two for as long as one reading comes after the other."""
        server = self.servers[0]
        assert isinstance(server, ModbusServer)
        reading = 1.0 / self.settings.rate
        images = math.ceil(reading / self.file.period)
        server.tear(images + 1 if images > 1 else 1)


def modbus_cases() -> dict[str, Callable[[], Case]]:
    """Return a maker of each case by its name."""
    found: dict[str, Callable[[], Case]] = {
        f"modbus {path.stem}": partial(ModbusCase, path.stem)
        for path in sorted(ModbusSettings.shipped.glob("*.yaml"))
    }
    found["modbus, a map that no code knows"] = partial(ModbusCase, str(INVENTED))
    return found
