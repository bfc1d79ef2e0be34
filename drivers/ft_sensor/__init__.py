"""Force-torque sensors: separate links that can be joined with any arm's driver."""

from __future__ import annotations

from pkgutil import resolve_name
from typing import TYPE_CHECKING, cast

from gapbridge.core.errors import LinkError
from gapbridge.drivers.clock import SYSTEM, Clock

if TYPE_CHECKING:
    from gapbridge.drivers.ft_sensor.sensor import ForceTorqueSensor
    from gapbridge.drivers.ft_sensor.settings import FtSensorSettings

FT_SENSORS: dict[str, str] = {
    "robotous_rft": "gapbridge.drivers.ft_sensor.robotous_rft:RobotousRft",
    "ati_netcanoem": "gapbridge.drivers.ft_sensor.ati_netcanoem:AtiNetCanOem",
    "robotiq_ft300": "gapbridge.drivers.ft_sensor.robotiq_ft300:RobotiqFt300",
}
"""Sensor name in a cell file -> ``module:Class``, imported when it is used."""


def make_sensor(settings: FtSensorSettings, clock: Clock = SYSTEM) -> ForceTorqueSensor:
    """Return the sensor that the settings name, not yet connected.

    Raises LinkError if it is unknown or its library is missing.
    """
    name = settings.driver
    if name not in FT_SENSORS:
        raise LinkError(
            f"ft_sensor.driver: found {name!r}, expected one of {', '.join(FT_SENSORS)}"
        )
    try:
        sensor_class = resolve_name(FT_SENSORS[name])
    except ImportError as error:
        raise LinkError(f"ft_sensor.driver {name}: cannot be imported: {error}") from None
    return cast("ForceTorqueSensor", sensor_class(settings, clock))
