"""Interpolation: from setpoints at irregular times to one for every cycle."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from gapbridge.bridge.setpoint_source.source import Source, SourceContext, SourceDryError
from gapbridge.core.arrays import Array
from gapbridge.drivers.clock import Clock

MAX_INTERVAL = 0.1  # s: longest time over which one setpoint is approached
SHORTENED = 0.5  # s per s by which that time shrinks: catching up, the arm is twice as fast at most


class SetpointInterpolator:
    """Moves linearly to the newest setpoint over the time between the last two.

    After a late one, which the next follows sooner, that time shrinks only slowly: else the way of
    two would be asked for in what is left of their time. Without a new setpoint for ``timeout`` s
    the source is dry. ``expected``: what should have come, for messages. ``rate``: of the cycles in
    which it is sampled, Hz.
    """

    def __init__(self, timeout: float, expected: str, rate: float, clock: Clock) -> None:
        self._now = clock.monotonic
        self._timeout, self._expected, self._cycle = timeout, expected, 1.0 / rate
        self._newest: Array | None = None
        self._last_received = 0.0  # s, monotonic
        self._from: Array | None = None
        self._length = 0.0  # s
        self._present: Array | None = None
        self._begun = self._sampled = 0.0  # s, monotonic: of the segment, of the present setpoint

    @property
    def goal(self) -> Array | None:
        """Return the setpoint (n,) rad that a motion goes to; None: no motion goes on."""
        return None if self._present is None else self._newest

    def take(self, q: Array, anew: bool = False) -> None:
        """Store a new setpoint (n,), rad; ``anew``: from another sender than the last one."""
        now = self._now()
        interval = MAX_INTERVAL if anew else min(now - self._last_received, MAX_INTERVAL)
        shortened = self._length - SHORTENED * interval
        self._length = max(interval, shortened) if self._newest is not None else 0.0
        self._newest, self._last_received = q, now

    def first(self) -> Array | None:
        """Return the newest setpoint (n,) rad, None if it is older than the timeout."""
        if self._newest is None or self._now() - self._last_received > self._timeout:
            return None
        return self._newest

    def forget(self) -> None:
        """Wait for a new setpoint, as if none had come: no motion goes on."""
        self._newest = self._present = None

    def begin(self, robot_q: Array) -> None:
        """Start at the newest setpoint.

        The way to it from the arm's joints ``robot_q`` (n,) rad is the stream's lead-in: here it
        would be covered in the time between two setpoints.
        """
        self._present, self._sampled = self._newest, self._now()
        self.restart()

    def restart(self) -> None:
        """Start a new segment from the present to the newest setpoint.

        It begins when the present one was sampled, a cycle ago: else the arm would stand for a
        cycle at each setpoint, and all the time where one comes in each cycle.
        """
        self._from = self._present if self._present is not None else self._newest
        self._begun = max(self._sampled, self._last_received - self._cycle)

    def sample(self) -> Array:
        """Return the present setpoint (n,) rad. Raises SourceDryError after the timeout."""
        now = self._now()
        silent = now - self._last_received
        if self._newest is None or silent > self._timeout:
            raise SourceDryError(f"setpoints: found no {self._expected} for {silent:.3f} s")
        self._sampled, left = now, self._length - silent
        if left <= 0.0 or self._from is None:
            self._present = self._newest
        else:
            share = (now - self._begun) / (now - self._begun + left)
            self._present = self._from + share * (self._newest - self._from)
        return self._present


class InterpolatedSource(Source):
    """A source whose setpoints arrive at irregular times and are interpolated."""

    expected: ClassVar[str]  # what the sender should send, for messages

    def __init__(self, context: SourceContext) -> None:
        super().__init__(context)
        self._clock = context.clock
        self._interpolator = SetpointInterpolator(
            self.settings.timeout, self.expected, context.rate, context.clock
        )

    @abstractmethod
    def _receive(self) -> bool:
        """Read what has arrived; returns whether there is a new setpoint."""

    def listen(self) -> None:
        """Read what has arrived; see Source.listen."""
        self._receive()

    def discard(self) -> None:
        """Drop what has arrived; see Source.discard."""
        self._receive()
        self._interpolator.forget()

    def first(self, robot_q: Array) -> Array | None:
        """Return the newest setpoint (n,) rad, None if it is older than the timeout."""
        self._receive()
        return self._interpolator.first()

    def begin(self, timestamp: float, robot_q: Array) -> None:
        """Start at the arm's joints ``robot_q`` (n,) rad."""
        self._interpolator.begin(robot_q)

    def sample(self, timestamp: float, robot_q: Array) -> Array:
        """Return the present setpoint (n,) rad. Raises SourceDryError after the timeout."""
        if self._receive():
            self._interpolator.restart()
        return self._interpolator.sample()
