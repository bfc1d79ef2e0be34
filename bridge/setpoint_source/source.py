"""What a source of nominal setpoints is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import NamedTuple

from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.core.arrays import Array
from gapbridge.core.errors import RunError


class SourceStatus(NamedTuple):
    """What the loop did in one cycle. A tuple, because one is made in each."""

    state: int  # of the supervisor
    nominal_q: Array  # (n,) rad
    corrected_q: Array  # (n,) rad
    offset_in_base: Array  # (6,) m, rad
    written: bool  # the corrected setpoint has left
    clamped: int  # bits of the limiter


class SourceDryError(RunError):
    """A source has no setpoint where it should have one: the arm must hold."""


class Source(ABC):
    """Nominal joint setpoints, one per cycle, at the controller's clock. For one thread.

    Constructors read what they need and open nothing. ``sample`` never blocks.
    """

    def __init__(
        self, settings: SetpointSettings, n: int, moves_arm: bool, folder: Path, rate: float
    ) -> None:
        self.settings = settings
        self.n = n
        self.rate = rate  # of the robot's cycles, Hz

    def open(self) -> None:
        """Open what the source listens on. Raises RunError."""

    @abstractmethod
    def first(self, robot_q: Array) -> Array | None:
        """Return where the source would start (n,), rad; None where it has nothing yet.

        ``own_q`` is what the robot itself wants now, (n,) rad. The caller checks that the start is
        near the arm: starting never jumps.
        """

    def begin(self, timestamp: float, robot_q: Array) -> None:
        """Start the motion at controller time ``timestamp`` (s)."""

    @abstractmethod
    def sample(self, timestamp: float, robot_q: Array) -> Array:
        """Return the setpoint (n,) rad at controller time ``timestamp``. Raises SourceDryError."""

    def emit(self, reported: SourceStatus) -> None:
        """Take note of what the loop did in this cycle, for whom it concerns. Never blocks."""

    @property
    def ended(self) -> bool:
        """Return whether the source has come to its end, and stays there."""
        return False

    def close(self) -> None:
        """Close what ``open`` has opened; may be repeated."""
