"""What is measured on one link: a cycle of ours in its three parts, and the bare library's.

Both sides use the same library object, socket and simulated controller, in turns of a few cycles,
so that whatever else the machine does meets both. The library does the same wire work: it reads and
decodes the same data, and writes the same values, and nothing else: no check of any kind.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.compensation import Compensator
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.driver import Driver

Vector = NDArray[np.float64]
Step = Callable[[], None]


Pause = Callable[[float], None]  # waits so many s


def spin(seconds: float) -> None:
    """Wait without giving the processor away, as a loop that owns one finds its caches."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        pass


def nothing(*_: Any) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class Cycles:
    """The two sides of one link, ready to be run."""

    ours: tuple[Step, Step, Step]  # read, compensate, write
    library: tuple[Step, Step]  # read, write
    wait: Step  # until there is something to read; not timed
    turn: Callable[[bool], None] = nothing  # before each turn, True: ours; not timed
    threads: tuple[int, ...] = ()  # ids of threads that work for the cycle beside the caller


class LinkCase(ABC):
    """One link."""

    name: str
    """What the results call it."""
    library: str
    """The library that it is compared with."""

    @abstractmethod
    def served(self, pause: Pause) -> AbstractContextManager[Cycles]:
        """Serve the simulated controller and yield the two sides, armed.

        ``pause`` is how the sides wait between two cycles.
        """


class OurCycle:
    """Read, compensate, write, as the daemon's loop has them; the arm stays where it is.

    ``hold``: joints that are commanded whatever comes out, where setpoints move the arm; the same
    work, but nothing wanders off. None: what comes out is written.
    """

    def __init__(self, driver: Driver, model: Model) -> None:
        self.driver = driver
        self.hold: Vector | None = None
        self._compensator = Compensator(model)
        # compiled now: an armed controller waits for nobody
        self._found = self._compensator.correct(np.zeros(model.arm.n))
        self._state: RobotState

    def read(self) -> None:
        """Take the next state."""
        self._state = self.driver.read_state()

    def compensate(self) -> None:
        """Correct what the robot itself wants."""
        self._nominal = self.driver.nominal_q(self._state)
        self._found = self._compensator.correct(self._nominal)

    def write(self) -> None:
        """Send the corrected setpoint."""
        found = self._found
        q = found.q if self.hold is None else self.hold
        self.driver.write_setpoint(Setpoint(q, self._nominal, found.offset_in_base))

    @property
    def steps(self) -> tuple[Step, Step, Step]:
        """Return the three parts."""
        return self.read, self.compensate, self.write
