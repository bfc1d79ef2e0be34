"""Motions: they turn a command into one joint target per cycle.

A motion is stepped once per cycle and says when it is done. Servo and speed motions never are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol

from gapbridge.drivers.simulated.plant.kinematics import Joints, between, gap, solve, tcp_in_base
from gapbridge.drivers.simulated.plant.plant_arm import Frame, PlantArm


class Motion(Protocol):
    """One running motion; `scaled` ones slow down with the speed slider."""

    done: bool
    scaled: bool
    failed: bool

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """Return the next joint target (n, rad) after `q`, which moves at `qd` (rad/s)."""
        ...

    def restart(self, q: Joints) -> None:
        """Go on from `q` after a pause."""
        ...


def ramp_share(distance: float, speed: float, acceleration: float, t: float) -> tuple[float, bool]:
    """Return the share (0..1) of a trapezoidal move after `t` s, and whether it has ended."""
    if distance <= 0.0:
        return 1.0, True
    rise = min(speed / acceleration, math.sqrt(distance / acceleration))
    top = acceleration * rise
    cruise = distance / top - rise
    total = 2.0 * rise + cruise
    if t >= total:
        return 1.0, True
    if t < rise:
        travelled = 0.5 * acceleration * t * t
    elif t < rise + cruise:
        travelled = top * (t - 0.5 * rise)
    else:
        travelled = distance - 0.5 * acceleration * (total - t) ** 2
    return travelled / distance, False


class Stateless:
    """A motion that cannot fail and is not affected by a pause."""

    failed = False

    def restart(self, q: Joints) -> None:
        """Do nothing: every step starts from where the arm is."""


class Hold(Stateless):
    """Hold the present joints."""

    scaled = False
    done = True

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """Return `q`."""
        return q


class MoveJoints:
    """moveJ: all joints along one trapezoid; speed and acceleration are the leading joint's."""

    failed = False
    scaled = True

    def __init__(self, start: Joints, goal: Joints, speed: float, acceleration: float) -> None:
        self.done = False
        self._goal, self._speed, self._acceleration = goal, speed, acceleration
        self.restart(start)

    def restart(self, q: Joints) -> None:
        """Restart from `q`, with the same goal."""
        self._start, self._t = q, 0.0
        self._way = max(abs(b - a) for a, b in zip(q, self._goal, strict=True))

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """Return the next joint target."""
        self._t += dt
        share, self.done = ramp_share(self._way, self._speed, self._acceleration, self._t)
        if self.done:
            return self._goal
        return tuple(a + share * (b - a) for a, b in zip(self._start, self._goal, strict=True))


class MoveLine:
    """moveL: the TCP along a straight line, inverse kinematics in every cycle."""

    scaled = True

    def __init__(
        self,
        arm: PlantArm,
        tool: Frame,
        start: Joints,
        goal: Frame,
        speed: float,
        acceleration: float,
    ) -> None:
        self.done = False
        self.failed = False
        self._arm, self._tool = arm, tool
        self._goal, self._speed, self._acceleration = goal, speed, acceleration
        self.restart(start)

    def restart(self, q: Joints) -> None:
        """Restart from `q`, with the same goal."""
        self._start, self._t = tcp_in_base(self._arm, q, self._tool), 0.0
        step = gap(self._start, self._goal)
        shift, turn = math.hypot(*step[:3]), math.hypot(*step[3:])
        self._way = max(shift, 0.2 * turn)  # a pure turn has a pace too: 1 rad as 0.2 m

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """Return the next joint target; the motion fails if the line leaves the workspace."""
        self._t += dt
        share, self.done = ramp_share(self._way, self._speed, self._acceleration, self._t)
        joints = solve(self._arm, between(self._start, self._goal, share), q, self._tool, steps=12)
        if joints is None:
            self.failed = self.done = True
            return q
        return joints


class Stop(Stateless):
    """stopJ: every joint brakes along its path, the fastest with `deceleration` (rad/s^2)."""

    scaled = False

    def __init__(self, qd: Joints, deceleration: float) -> None:
        fastest = max(map(abs, qd))
        self.done = fastest < 1e-9
        self._qd, self._left, self._fastest = qd, fastest, fastest
        self._deceleration = deceleration

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """Return the next joint target."""
        self._left = max(self._left - self._deceleration * dt, 0.0)
        self.done = self._left <= 0.0
        if self._fastest <= 0.0:
            return q
        share = self._left / self._fastest
        return tuple(a + v * share * dt for a, v in zip(q, self._qd, strict=True))


class MovePath:
    """Several motions, one after the other; each is created when it starts."""

    scaled = True

    def __init__(
        self, makers: Sequence[Callable[[Joints], Motion]], reached: Callable[[int], None]
    ) -> None:
        self.done = not makers
        self.failed = False
        self._makers, self._reached = list(makers), reached
        self._index = -1
        self._motion: Motion | None = None

    def restart(self, q: Joints) -> None:
        """Go on with the move that was interrupted."""
        if self._motion is not None:
            self._motion.restart(q)

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """Return the next joint target; the path fails with any of its moves."""
        if self.done:
            return q
        if self._motion is None:
            self._index += 1
            self._reached(self._index)
            self._motion = self._makers[self._index](q)
        joints = self._motion.step(q, qd, dt)
        if self._motion.done:
            self.failed = self._motion.failed
            self._motion = None
            self.done = self.failed or self._index + 1 >= len(self._makers)
        return joints
