"""The axes under simulated drives: they follow setpoints between SYNCs, brake, stand."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Protocol

from gapbridge.drivers.simulated.canopen.machine import Machine, Phase
from gapbridge.drivers.simulated.server.arm_controller import ArmController

BLOCKED, EMERGENCY = 0x7121, 0x5441  # error codes
BRAKING = 12.0  # rad/s^2, of a quick stop and of a fault's reaction
FOLLOWING = 0.35  # rad: largest following error
INTERPOLATED, SYNCHRONOUS = 7, 8  # modes of operation
RUN = 0x10  # Controlword: interpolate


@dataclass
class Axis:
    """One joint under its drive, rad; ``demand`` is the drive's present position demand."""

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

    @property
    def healthy(self) -> bool:
        """Return whether the drive has no fault."""
        return self.machine.phase not in (Phase.FAULT, Phase.REACTION)

    def set_mode(self, mode: int) -> None:
        """Change the mode of operation."""
        self.mode = mode

    def setpoint(self, angle: float) -> bool:
        """Store the setpoint of a SYNC; returns False if it is too far away to be followed."""
        if not self.active:
            self._to = None
            return True
        self._from, self._to, self._age = self.demand, angle, 0.0
        return math.isfinite(angle) and abs(angle - self.demand) <= FOLLOWING

    def step(self, dt: float, period: float, actual: float) -> None:
        """Advance by ``dt`` s; ``period``: s between two SYNCs."""
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
            self.machine.end_braking()


class DrivenAxis(Protocol):
    """A drive with its axis."""

    axis: Axis

    def fail(self, code: int) -> None:
        """Go to FAULT with an error code, and report it."""
        ...


def move_axes(controller: ArmController, dt: float, axes: Iterable[tuple[Axis, float]]) -> None:
    """Advance the axes, each with the time between two SYNCs, and the arm with them; s."""
    goal, holding = list(controller.target_q), False
    for joint, (axis, period) in enumerate(axes):
        axis.step(dt, period, goal[joint])
        if axis.holds:
            holding, goal[joint] = True, axis.demand
    if holding:
        controller.command(goal)
    elif controller.commanded:
        controller.let_go()


def follow_stops(controller: ArmController, drives: Iterable[DrivenAxis], was_able: bool) -> bool:
    """Fail every drive at a stop of the arm; a fault that is reset ends a protective stop.

    ``was_able``: whether the arm could move at the call before; returns whether it can.
    """
    able = controller.can_move
    for drive in drives:
        if not controller.can_move and was_able and drive.axis.healthy:
            drive.fail(EMERGENCY if controller.emergency else BLOCKED)
        elif controller.emergency and drive.axis.healthy:
            drive.fail(EMERGENCY)
        elif controller.protective and drive.axis.healthy:
            controller.unlock()
    return able
