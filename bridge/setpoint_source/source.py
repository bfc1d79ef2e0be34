"""The base class of sources of nominal setpoints."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.core.arrays import Array
from gapbridge.core.errors import RunError
from gapbridge.drivers.clock import Clock


class SourceStatus(NamedTuple):
    """What the loop did in one cycle. A tuple, because one is made in each."""

    state: int  # of the supervisor
    nominal_q: Array  # (n,) rad
    corrected_q: Array  # (n,) rad
    offset_in_base: Array  # (6,) m, rad
    written: bool  # the corrected setpoint was sent
    clamped: int  # bits of the limiter


@dataclass(frozen=True)
class SourceContext:
    """What a source is made of; ``folder`` is where relative paths start."""

    settings: SetpointSettings
    n: int  # joints
    moves_arm: bool  # setpoints are the arm's only motion
    folder: Path
    rate: float  # of the robot's cycles, Hz
    clock: Clock  # for setpoints that come at their own times


class SourceDryError(RunError):
    """A source has no setpoint in time: the arm must hold."""


class Source(ABC):
    """Nominal joint setpoints, one per cycle, at the controller's clock. For one thread.

    Constructors read what they need and open nothing. ``sample`` never blocks.
    """

    def __init__(self, context: SourceContext) -> None:
        self.settings = context.settings
        self.n = context.n
        self.rate = context.rate  # of the robot's cycles, Hz

    def open(self) -> None:
        """Open what the source listens on. Raises RunError."""

    def listen(self) -> None:
        """Read what has arrived; called in each cycle in which no setpoint is asked for.

        So that what has arrived is never older than a cycle. Never blocks.
        """

    def discard(self) -> None:
        """Drop what has arrived: the loop was not reading, so that nobody knows how old it is."""

    @abstractmethod
    def first(self, robot_q: Array) -> Array | None:
        """Return the first setpoint (n,), rad; None if there is none yet.

        ``robot_q``: the robot's own target joints, (n,) rad. The caller checks that the first
        setpoint is near the arm.
        """

    def begin(self, timestamp: float, robot_q: Array) -> None:
        """Start the motion at controller time ``timestamp`` (s)."""

    @abstractmethod
    def sample(self, timestamp: float, robot_q: Array) -> Array:
        """Return the setpoint (n,) rad at controller time ``timestamp``. Raises SourceDryError."""

    def emit(self, reported: SourceStatus) -> None:
        """Report what the loop did in this cycle to the sender. Never blocks."""

    @property
    def ended(self) -> bool:
        """Return whether the source has reached its end and holds its last setpoint."""
        return False

    def close(self) -> None:
        """Close what ``open`` has opened; may be repeated."""
