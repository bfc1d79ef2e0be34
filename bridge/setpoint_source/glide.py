"""From setpoints that come now and then to one for every cycle."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import ClassVar

from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.setpoint_source.source import Source, SourceDryError
from gapbridge.core.arrays import Array
from gapbridge.drivers.clock import SYSTEM, Clock

LONGEST_GLIDE = 0.1  # s


class Glide:
    """The newest setpoint, come to over the time that two of them are apart.

    What has not been renewed for ``timeout`` s is dry.
    """

    def __init__(self, timeout: float, what: str, clock: Clock = SYSTEM) -> None:
        self._now = clock.monotonic
        self._timeout, self._what = timeout, what
        self._newest: Array | None = None
        self._last_received = 0.0  # s, monotonic
        self._from: Array | None = None
        self._length = 0.0  # s
        self._present: Array | None = None

    def take(self, q: Array) -> None:
        """Take a new setpoint (n,), rad."""
        now = self._now()
        self._length = (
            min(now - self._last_received, LONGEST_GLIDE) if self._newest is not None else 0.0
        )
        self._newest, self._last_received = q, now

    def first(self) -> Array | None:
        """Return the newest setpoint where one has come lately."""
        if self._newest is None or self._now() - self._last_received > self._timeout:
            return None
        return self._newest

    def begin(self, robot_q: Array) -> None:
        """Start from where the arm stands."""
        self._present = robot_q.copy()
        self.turn()

    def turn(self) -> None:
        """Glide to the newest setpoint from where the stream is."""
        self._from = self._present if self._present is not None else self._newest

    def sample(self) -> Array:
        """Return the setpoint of this moment. Raises SourceDryError where none came in time."""
        silent = self._now() - self._last_received
        if self._newest is None or silent > self._timeout:
            raise SourceDryError(f"setpoints: found no {self._what} for {silent:.3f} s")
        share = min(silent / self._length, 1.0) if self._length > 0.0 else 1.0
        if share >= 1.0 or self._from is None:
            self._present = self._newest
        else:
            self._present = self._from + share * (self._newest - self._from)
        return self._present


class GlidingSource(Source):
    """A source whose setpoints come when their sender likes; the stream glides between them."""

    counted: ClassVar[str]  # what a sender sends anew, for messages

    def __init__(
        self, settings: SetpointSettings, n: int, moves_arm: bool, folder: Path, rate: float
    ) -> None:
        super().__init__(settings, n, moves_arm, folder, rate)
        self._glide = Glide(settings.timeout, self.counted)

    @abstractmethod
    def _receive(self) -> bool:
        """Take what has arrived; returns whether there is a new setpoint."""

    def first(self, robot_q: Array) -> Array | None:
        """Return the newest setpoint where one has come lately."""
        self._receive()
        return self._glide.first()

    def begin(self, timestamp: float, robot_q: Array) -> None:
        """Start from where the arm stands."""
        self._glide.begin(robot_q)

    def sample(self, timestamp: float, robot_q: Array) -> Array:
        """Return the setpoint of this moment. Raises SourceDryError where none came in time."""
        if self._receive():
            self._glide.turn()
        return self._glide.sample()
