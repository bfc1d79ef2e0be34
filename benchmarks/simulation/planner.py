"""A planner, and the source that takes its setpoints."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from benchmarks.simulation.links import SimulatedLink
from benchmarks.simulation.world import SimulatedClock, World
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.setpoint_source.interpolator import SetpointInterpolator
from gapbridge.bridge.setpoint_source.source import Source

Vector = NDArray[np.float64]
Nonsense = Callable[[Vector], Vector]
PLANNED = 0.02  # s between two setpoints of the planner


class Planner:
    """Sends setpoints: a slow circle of one joint about where the arm stands, or nonsense."""

    def __init__(self, world: World, link: SimulatedLink, joint: int) -> None:
        self._world, self._link, self.joint = world, link, joint
        self.take: Callable[[Vector], None] = lambda _: None
        self.silent_until = 0.0
        self.nonsense: Nonsense | None = None
        self._at: Vector | None = None
        self._time = 0.0
        world.every(lambda: PLANNED, self._send)

    def _send(self) -> None:
        if self._at is None or self._link.supervisor_state() != State.COMPENSATING:
            self._at, self._time = np.array(self._link.controller.q), 0.0  # begins there
        if self._world.now < self.silent_until:
            return
        self._time += PLANNED
        q = self._at.copy()
        q[self.joint] += 0.02 * np.sin(0.5 * self._time) ** 2
        if self.nonsense is not None:
            q = self.nonsense(q)
        self.take(q)


class PlannedSource(Source):
    """What a planner sends, by the product's own interpolator; its socket is not simulated."""

    def attach(self, planner: Planner, clock: SimulatedClock) -> None:
        """Take what the planner sends from now on."""
        self._interpolator = SetpointInterpolator(self.settings.timeout, "line", self.rate, clock)
        planner.take = self._take

    def _take(self, q: Vector) -> None:
        if not np.isfinite(q).all():
            return  # a line that is no setpoint never comes so far
        self._interpolator.take(q)
        self._interpolator.restart()

    def discard(self) -> None:
        """See Source.discard."""
        self._interpolator.forget()

    def first(self, robot_q: Vector) -> Vector | None:
        """See Source.first."""
        return self._interpolator.first()

    def begin(self, timestamp: float, robot_q: Vector) -> None:
        """See Source.begin."""
        self._interpolator.begin(robot_q)

    def sample(self, timestamp: float, robot_q: Vector) -> Vector:
        """See Source.sample."""
        return self._interpolator.sample()
