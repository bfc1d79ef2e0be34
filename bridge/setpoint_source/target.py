"""Setpoints of the robot's own program, or its present joints."""

from __future__ import annotations

from gapbridge.bridge.setpoint_source.source import Source, SourceContext
from gapbridge.core.arrays import Array


class TargetSource(Source):
    """The arm's own ``target_q``.

    If setpoints are the arm's only motion, its target is the setpoint written last: then the source
    holds the joints at which writing began.
    """

    def __init__(self, context: SourceContext) -> None:
        super().__init__(context)
        self._holds_start = context.moves_arm
        self._start: Array | None = None

    def first(self, robot_q: Array) -> Array | None:
        """Return the robot's own target."""
        return robot_q

    def begin(self, timestamp: float, robot_q: Array) -> None:
        """Store the arm's joints, if setpoints are its only motion."""
        self._start = robot_q.copy() if self._holds_start else None

    def sample(self, timestamp: float, robot_q: Array) -> Array:
        """Return the robot's own target, or the joints at the start."""
        return robot_q if self._start is None else self._start
