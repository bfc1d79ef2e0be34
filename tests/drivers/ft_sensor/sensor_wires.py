"""Sensors on real wires: each kind with its simulated device, its settings and its resolution."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from patience import PATIENCE
from pydantic import TypeAdapter

from gapbridge.core.arm import builtin_arm
from gapbridge.core.rotation import rpy_matrix
from gapbridge.drivers.can_bus.bus import BusSettings
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.ft_sensor.sensor import ForceTorqueSensor, Reading
from gapbridge.drivers.ft_sensor.settings import AnyFtSensor, FtSensorSettings
from gapbridge.drivers.simulated.ft_sensor.ati_node import AtiNode, RobotousNode
from gapbridge.drivers.simulated.ft_sensor.ft300_device import Ft300Device
from gapbridge.drivers.simulated.ft_sensor.node import SimulatedSensor, reaction_at
from gapbridge.drivers.simulated.plant.plant_arm import plant_arm
from gapbridge.drivers.simulated.plant.plant_settings import draw_plant_settings
from gapbridge.drivers.simulated.server.arm_controller import ArmController, make_controller

Array = NDArray[np.float64]
KINDS = ("robotous_rft", "ati_netcanoem", "robotiq_ft300", "robotiq_ft300 registers")
# N and Nm that one count is worth, at most
RESOLUTION = {"robotous_rft": (0.02, 0.0005), "ati_netcanoem": (0.05, 0.005),
              "robotiq_ft300": (0.01, 0.001), "robotiq_ft300 registers": (0.01, 0.001)}  # fmt: skip
MASS, COG = 4.0, (0.01, -0.02, 0.07)
XYZ, RPY = (0.0, 0.003, 0.045), (0.1, -0.2, 0.7)
_channels = itertools.count()
_settings: TypeAdapter[Any] = TypeAdapter(AnyFtSensor)


def settings_of(**keys: Any) -> FtSensorSettings:
    """Return the section ``ft_sensor`` of these keys."""
    found: FtSensorSettings = _settings.validate_python(keys)
    return found


@dataclass
class Reaction:
    """What the device is made to feel; a plant behind it is felt through ``felt_by``."""

    wrench: tuple[float, ...] = (3.0, -4.5, 12.25, 0.35, -0.6, 1.1)

    def __call__(self) -> Any:
        return self.wrench


@dataclass
class Wire:
    """A simulated device with the settings that reach it."""

    device: SimulatedSensor
    keys: dict[str, Any] = field(default_factory=dict)

    def settings(self, **more: Any) -> FtSensorSettings:
        keys = {"when_lost": "stop", **self.keys, **more}
        if isinstance(self.device, Ft300Device):
            keys["port"] = self.device.path
        return settings_of(**keys)


def make_wire(kind: str, reaction: Callable[[], Any]) -> Wire:
    """Return a device of a kind on a wire of its own, not yet started."""
    name, *mode = kind.split()
    if name == "robotiq_ft300":
        keys: dict[str, Any] = {"driver": name, "mode": (mode or ["stream"])[0], "max_age": 1.0}
        return Wire(Ft300Device(reaction, SYSTEM), keys)
    channel = f"ft-{os.getpid()}-{next(_channels)}"
    bus = BusSettings(interface="virtual", channel=channel)
    keys = {"driver": name, "interface": "virtual", "channel": channel, "max_age": 1.0}
    node = (
        RobotousNode(reaction, bus, SYSTEM)
        if name == "robotous_rft"
        else AtiNode(reaction, bus, seed=5)
    )
    return Wire(node, keys)


def next_reading(sensor: ForceTorqueSensor, limit: float = PATIENCE) -> Reading:
    """Return the next sample; a busy machine may take a while."""
    until = time.monotonic() + limit
    while time.monotonic() < until:
        found = sensor.read(0.2)
        if found is not None:
            return found
    raise AssertionError(f"no sample within {limit:g} s, {sensor.dropped} dropped")


def resting_controller(q: tuple[float, ...]) -> ArmController:
    """Return an arm at rest with a known mass on its flange; its sensor has no noise, no bias."""
    arm = plant_arm("ur10e")
    plant = replace(
        draw_plant_settings(arm, 3), payload_mass=MASS, payload_cog=COG, force_noise=0.0,
        torque_noise=0.0, sensor_bias=(0.0,) * 6, axial=(0.0,) * 6, radial=(0.0,) * 6,
        tcp=(0.0, 0.0, 0.18, 0.0, 0.0, 0.0),
    )  # fmt: skip
    controller = make_controller(arm, plant, q, 0.004)
    for _ in range(5):
        controller.cycle()
    return controller


def reaction_of(controller: ArmController, sign: int = 1) -> Callable[[], Any]:
    """Return what a sensor mounted at XYZ, RPY on the arm's flange measures."""
    return reaction_at(lambda: controller.raw_wrench, XYZ, RPY, sign)


def flange_rotation(q: tuple[float, ...]) -> Array:
    """Return the flange's rotation in base, from the arm's own table."""
    flange = plant_arm(builtin_arm("ur10e")).flange(q).rotation
    return np.array(flange, dtype=float).reshape(3, 3)


def sensor_rotation() -> Array:
    return rpy_matrix(np.array(RPY))
