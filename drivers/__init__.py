"""Drivers: the interface between controllers and the loop, one folder per protocol."""

from __future__ import annotations

from pkgutil import resolve_name
from typing import TYPE_CHECKING, cast

from gapbridge.core.errors import LinkError
from gapbridge.drivers.clock import SYSTEM, Clock

if TYPE_CHECKING:
    from gapbridge.core.model import Model
    from gapbridge.drivers.driver import Driver
    from gapbridge.drivers.gate import GateBounds
    from gapbridge.drivers.link_settings import DriverSettings

DRIVERS: dict[str, str] = {
    "can": "gapbridge.drivers.can.driver:CanDriver",
    "canopen": "gapbridge.drivers.canopen.driver:CanopenDriver",
    "modbus": "gapbridge.drivers.modbus.driver:ModbusDriver",
    "replay": "gapbridge.drivers.replay.driver:ReplayDriver",
    "ur_rtde": "gapbridge.drivers.ur_rtde.driver:UrRtdeDriver",
}
"""Driver name in a cell file -> ``module:Class``, imported when it is used."""


def make_driver(
    settings: DriverSettings, model: Model, bounds: GateBounds | None = None, clock: Clock = SYSTEM
) -> Driver:
    """Return the driver that the settings name, not yet connected.

    ``model`` gives it the arm and the tool, ``bounds`` the limits of its gate (None: the defaults
    of a cell file), ``clock`` the time. Raises LinkError if the driver's library is missing.
    """
    name = str(getattr(settings, "driver", ""))
    if name not in DRIVERS:
        raise LinkError(f"link.driver: found {name!r}, expected one of {', '.join(DRIVERS)}")
    try:
        driver_class = resolve_name(DRIVERS[name])
    except ImportError as error:
        raise LinkError(f"link.driver {name}: its library cannot be imported: {error}") from None
    driver = cast("Driver", driver_class(settings, model, clock))
    if bounds is not None:
        driver.gate.set_bounds(bounds)
    return driver
