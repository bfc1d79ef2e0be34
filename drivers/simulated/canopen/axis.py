"""What one drive does with its axis: follows setpoints between SYNCs, brakes, stands."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from gapbridge.drivers.simulated.canopen.machine import Machine, Phase

BRAKING = 12.0  # rad/s^2, of a quick stop and of a fault's reaction
FOLLOWING = 0.35  # rad that the joint may be away from its setpoint
INTERPOLATED, SYNCHRONOUS = 7, 8  # modes of operation
RUN = 0x10  # Controlword: interpolate


@dataclass
class Axis:
    """One joint under its drive, rad; ``demand`` is where the drive wants it now."""

    demand: float
    speed: float = 0.0  # rad/s, of the demand
    mode: int = 0
    machine: Machine = field(default_factory=Machine)
    _from: float = 0.0
    _to: float | None = None
    _age: float = 0.0  # s since the SYNC that brought the setpoint

    @property
    def active(self) -> bool:
        """Return whether setpoints are followed: bit 12 of the Statusword."""
        if self.machine.phase is not Phase.ENABLED:
            return False
        if self.mode == INTERPOLATED:
            return bool(self.machine.word & RUN)
        return self.mode == SYNCHRONOUS

    @property
    def holds(self) -> bool:
        """Return whether the drive has power over the axis."""
        return self.machine.phase in (Phase.ENABLED, Phase.QUICK_STOP, Phase.REACTION)

    def setpoint(self, angle: float) -> bool:
        """Take the setpoint of a SYNC; returns False where it is too far away to be followed."""
        if not self.active:
            self._to = None
            return True
        self._from, self._to, self._age = self.demand, angle, 0.0
        return math.isfinite(angle) and abs(angle - self.demand) <= FOLLOWING

    def step(self, dt: float, period: float, actual: float) -> None:
        """Advance by ``dt`` s; ``period`` (s) lies between two SYNCs."""
        phase = self.machine.phase
        if phase in (Phase.QUICK_STOP, Phase.REACTION):
            self._brake(dt)
            return
        if not self.holds:
            self.demand, self.speed, self._to = actual, 0.0, None
            return
        if self._to is None or not self.active:
            self.speed = 0.0
            return
        self._age += dt
        before = self.demand
        share = min(self._age / period, 1.0) if period > 0.0 else 1.0
        self.demand = self._from + share * (self._to - self._from)
        self.speed = (self.demand - before) / dt

    def _brake(self, dt: float) -> None:
        slower = max(abs(self.speed) - BRAKING * dt, 0.0)
        self.speed = math.copysign(slower, self.speed)
        self.demand += self.speed * dt
        self._to = None
        if self.speed == 0.0:
            self.machine.come_to_rest()
