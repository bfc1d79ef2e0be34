"""Cases of the contract: a Modbus arm joined with each kind of force-torque sensor."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

FT_SENSOR = str(Path(__file__).parents[1] / "ft_sensor")
sys.path.insert(0, FT_SENSOR)

from contract_modbus import ModbusCase  # noqa: E402
from sensor_wires import RESOLUTION, RPY, XYZ, make_wire, reaction_of  # noqa: E402

from gapbridge.drivers.driver import Driver  # noqa: E402
from gapbridge.drivers.ft_sensor.joined import DriverWithSensor  # noqa: E402


class SensorCase(ModbusCase):
    """An arm with a sensor on its flange; the force at the TCP is the sensor's."""

    def __init__(self, profile: str, kind: str) -> None:
        super().__init__(profile)
        self._wire = make_wire(kind, reaction_of(self.controller))
        self.force = RESOLUTION[kind][0]

    def driver(self) -> Driver:
        """Return the Modbus driver joined with the sensor."""
        frame = {"xyz": XYZ, "rpy": RPY}
        settings = self._wire.settings(sensor_in_flange=frame, max_age=1.0, connect_timeout=60.0)
        return DriverWithSensor(super().driver(), settings, self.model)

    def start(self) -> None:
        """Serve arm and sensor."""
        super().start()
        self._wire.device.start()

    def stop(self) -> None:
        """Switch both off."""
        self._wire.device.stop()
        super().stop()


def ft_sensor_cases() -> dict[str, Callable[[], ModbusCase]]:
    """Return a maker of each case by its name."""
    return {
        f"{arm} with {kind}": partial(SensorCase, arm, kind)
        for arm, kind in (
            ("igus", "robotous_rft"),
            ("ur", "ati_netcanoem"),
            ("jaka", "robotiq_ft300"),
        )
    }
