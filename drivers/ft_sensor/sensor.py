"""What a force-torque sensor is: connect, read, close; the same for every wire."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

from gapbridge.core.arrays import Array


@dataclass(frozen=True, slots=True)
class Reading:
    """One sample of a sensor: what the load does to it.

    A tool that hangs on the sensor at rest reads its weight, pointing down (docs/conventions.md,
    ``ft_raw_wrench``); ``settings.sign`` turns sensors around that report the reaction.
    """

    timestamp: float  # s, monotonic: when the sensor is reckoned to have sampled it
    received: float  # s, monotonic: when it had come in whole
    wrench: Array  # (6,) N, Nm: sensor axes, torque about the sensor's origin
    status: int = 0  # the sensor's own status or overload bits, 0 = fine


class ForceTorqueSensor(ABC):
    """One link to one sensor, for one thread. Constructors never touch hardware."""

    name = "force-torque sensor"  # how messages call it

    def __init__(self) -> None:
        self.dropped = 0  # frames or pairs that were not believed

    @abstractmethod
    def connect(self) -> None:
        """Open the link and have the sensor measure. Raises LinkError."""

    @abstractmethod
    def read(self, timeout: float) -> Reading | None:
        """Wait up to ``timeout`` s for the next sample; None where none has come.

        Garbage on the wire is dropped and counted in ``dropped``. Raises LinkError where the link
        itself is broken.
        """

    @abstractmethod
    def close(self) -> None:
        """Leave the link. Never raises; may be repeated."""

    def describe(self, status: int) -> str:
        """Return in words what a status that is not 0 means."""
        return f"status 0x{status:04X}"

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
