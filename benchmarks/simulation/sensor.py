"""A force-torque sensor on the flange: samples in memory, joined with any link's driver."""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np

from benchmarks.simulation.world import World
from gapbridge.core.errors import LinkError
from gapbridge.core.model import Model
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.ft_sensor.joined import DriverWithSensor, SensorReader
from gapbridge.drivers.ft_sensor.sensor import Reading
from gapbridge.drivers.ft_sensor.settings import Overload, RobotousSettings

EVERY = 0.005  # s
WAY = 1e-3  # s
WEIGHT = (0.0, 0.0, 49.0, 0.0, 0.0, 0.0)  # N, Nm
OVERLOAD = 500.0  # N
MAX_AGE = 0.1  # s
LOOK = 2e-3  # s


class Sensor:
    """Sends a sample every 5 ms, which may be missing or wrong."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._readings: Any = None  # of the reader that listens
        self._fault = ""
        self.arrived = -math.inf  # s: when the last good sample did
        world.every(lambda: EVERY, self._send)

    def joined(self, driver: Driver, model: Model, when_lost: str) -> Driver:
        """Return a driver whose states have this sensor's wrench."""
        settings = RobotousSettings.model_validate({
            "driver": "robotous_rft", "interface": "virtual", "max_age": MAX_AGE,
            "when_lost": when_lost, "overload": Overload(force=OVERLOAD),
        })  # fmt: skip
        found = DriverWithSensor(driver, settings, model)
        found._reader.__class__ = _Reader
        found._reader.attach(self, driver.clock)  # type: ignore[attr-defined]
        return found

    def listen(self, readings: Any) -> None:
        """Send samples to a reader from now on."""
        self._readings = readings

    def lose(self, draw: random.Random) -> str:
        """Be silent, or send what is no wrench."""
        self._fault = draw.choice(("silent", "silent", "error", "overload", "no number"))
        return self._fault

    def heal(self) -> None:
        """Send good samples again."""
        self._fault = ""

    def _send(self) -> None:
        if self._readings is None or self._fault == "silent":
            return
        now, wrench = self._world.now, np.array(WEIGHT)
        if self._fault == "overload":
            wrench[2] = 2.0 * OVERLOAD
        elif self._fault == "no number":
            wrench[0] = np.nan
        else:
            self.arrived = now
        self._readings.append(Reading(now - WAY, now, wrench, int(self._fault == "error")))


class _Reader(SensorReader):
    """The product's, whose thread and bus are the sensor itself."""

    def attach(self, sensor: Sensor, clock: Clock) -> None:
        """Take a sensor's samples once started."""
        self._source, self._clock = sensor, clock

    def start(self) -> None:
        """Listen, and wait for the first sample. Raises LinkError."""
        self._readings.clear()
        self._source.listen(self._readings)
        if not self.wait(self._settings.connect_timeout):
            raise LinkError(f"{self._sensor.name}: found no sample")

    def wait(self, timeout: float) -> bool:
        """Wait for the next sample up to ``timeout`` s; returns whether one has come."""
        until, last = self._now() + timeout, self._newest()
        while self._newest() == last:
            if self._now() > until:
                return False
            self._clock.sleep(LOOK)
        return True

    def _newest(self) -> float:
        return self._readings[-1].received if self._readings else 0.0

    def stop(self) -> None:
        """Listen no more."""
