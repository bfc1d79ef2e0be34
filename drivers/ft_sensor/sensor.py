"""The base class of force-torque sensors: connect, read, close."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

from gapbridge.core.arrays import Array
from gapbridge.drivers.clock import SYSTEM, Clock

DRIFT = 1e-4  # s per s: largest drift between two clocks
JUMP = 0.5  # s: a clock that is off by more was set


class ClockOffset:
    """How far another clock lags this machine's monotonic one, by a minimum filter over arrivals.

    Every arrival comes late by some delay; the least delay seen is the offset. What is constant in
    the delay cannot be distinguished from an offset by arrivals alone.
    """

    def __init__(self) -> None:
        self._offset: float | None = None  # s, monotonic minus theirs
        self._last = 0.0  # s, theirs

    def take(self, sensor_time: float, received: float) -> float:
        """Return when the sample stamped ``sensor_time`` was taken, s monotonic (<= ``received``).

        A sensor clock that jumps restarts the estimate.
        """
        lead, gap = received - sensor_time, sensor_time - self._last
        self._last = sensor_time
        if self._offset is None or gap < 0.0 or lead - self._offset > JUMP:
            self._offset = lead
        else:
            self._offset = min(lead, self._offset + DRIFT * gap)
        return min(sensor_time + self._offset, received)


@dataclass(frozen=True, slots=True)
class Reading:
    """One sample of a sensor: the wrench of the load on the sensor.

    A tool at rest reads its weight, pointing down (docs/conventions.md, ``ft_raw_wrench``);
    ``settings.sign`` inverts sensors that report the reaction.
    """

    timestamp: float  # s, monotonic: estimated sampling time
    received: float  # s, monotonic: when it was received completely
    wrench: Array  # (6,) N, Nm: sensor axes, torque about the sensor's origin
    status: int = 0  # the sensor's own status or overload bits, 0 = fine


class ForceTorqueSensor(ABC):
    """One link to one sensor, for one thread. Constructors never touch hardware."""

    name = "force-torque sensor"  # in messages

    def __init__(self, clock: Clock = SYSTEM) -> None:
        self.clock = clock  # of this machine; the sensor's own is estimated
        self.dropped = 0  # invalid frames or pairs

    @abstractmethod
    def connect(self) -> None:
        """Open the link and start measuring. Raises LinkError."""

    @abstractmethod
    def read(self, timeout: float) -> Reading | None:
        """Wait up to ``timeout`` s for the next sample; None if none has come.

        Invalid data is dropped and counted in ``dropped``. Raises LinkError if the link is broken.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the link. Never raises; may be repeated."""

    def describe(self, status: int) -> str:
        """Return a status other than 0 as text."""
        return f"status 0x{status:04X}"

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
