"""Streamed motions: servo and speed commands, which follow what the client sends every cycle."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gapbridge.drivers.simulated.plant.kinematics import Joints, jacobian
from gapbridge.drivers.simulated.plant.motion import Stateless
from gapbridge.drivers.simulated.plant.plant_arm import Frame, PlantArm

SERVO_ACCELERATION = 40.0  # rad/s^2


class Servo(Stateless):
    """servoJ: follow a target that may change every cycle, smoothed over the lookahead time."""

    scaled = False
    done = False

    def __init__(self, arm: PlantArm, goal: Joints, lookahead: float) -> None:
        self.goal = goal
        self.lookahead = lookahead
        self._limits = arm.velocity

    def aim(self, goal: Joints, lookahead: float) -> None:
        """Follow another target from now on."""
        self.goal, self.lookahead = goal, lookahead

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """Return the next joint target."""
        share = dt / max(0.25 * self.lookahead, dt)
        most = SERVO_ACCELERATION * dt
        joints = []
        for now, speed, goal, limit in zip(q, qd, self.goal, self._limits, strict=True):
            remaining = goal - now
            if abs(remaining) < 1e-9 and abs(speed) < 2.0 * most:
                joints.append(goal)
                continue
            # Never faster than what can still be braked before the goal.
            brake = math.sqrt(1.6 * SERVO_ACCELERATION * abs(remaining))
            wanted = min(max(remaining * share / dt, -brake, -limit), brake, limit)
            wanted = min(max(wanted, speed - most), speed + most)
            joints.append(now + wanted * dt)
        return tuple(joints)


class _Speed:
    """A velocity that is approached with an acceleration."""

    failed = False
    scaled = False
    done = False

    def __init__(self, goal: Sequence[float], acceleration: float) -> None:
        self.aim(goal, acceleration)

    def aim(self, goal: Sequence[float], acceleration: float) -> None:
        """Approach another velocity from now on."""
        self.goal, self.acceleration = tuple(float(v) for v in goal), acceleration

    def _after(self, now: Joints, dt: float) -> Joints:
        """Return the velocity one step after ``now``."""
        most = self.acceleration * dt
        return tuple(v + min(max(g - v, -most), most) for v, g in zip(now, self.goal, strict=True))


class SpeedJoints(_Speed):
    """speedJ: joints approach a velocity with an acceleration (leading joint)."""

    _now: Joints | None = None

    def restart(self, q: Joints) -> None:
        """Restart from standstill."""
        self._now = (0.0,) * len(q)

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """Return the next joint target."""
        self._now = self._after(qd if self._now is None else self._now, dt)
        return tuple(a + v * dt for a, v in zip(q, self._now, strict=True))


class SpeedTool(_Speed):
    """speedL: the TCP approaches a velocity in base axes (m/s, rad/s)."""

    _now: Joints = (0.0,) * 6

    def __init__(
        self, arm: PlantArm, tool: Frame, goal: Sequence[float], acceleration: float
    ) -> None:
        super().__init__(goal, acceleration)
        self._arm, self._tool = arm, tool

    def restart(self, q: Joints) -> None:
        """Restart from standstill."""
        self._now = (0.0,) * 6

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """Return the next joint target."""
        self._now = self._after(self._now, dt)
        J = jacobian(self._arm, q, self._tool)
        rates = J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), self._now)
        largest = max(
            abs(float(r)) / limit for r, limit in zip(rates, self._arm.velocity, strict=True)
        )
        rates = rates / max(1.0, largest)
        return tuple(a + float(v) * dt for a, v in zip(q, rates, strict=True))
