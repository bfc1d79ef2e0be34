"""The 'real' arm behind the simulated controller: hidden compliance, load, lag and scatter.

It shares no mathematics with the model in core: exact finite rotations on plain tuples, and its
own iteration to the equilibrium. Joint i bends at the origin of its joint frame, after its own
rotation, by exp([C_r M_x, C_r M_y, C_a M_z]); M is the moment of everything beyond about that
origin in the joint frame after bending; pulls act at the deflected TCP, payloads at the deflected
flange (the bending convention of the project).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gapbridge.drivers.simulated.plant.plant_arm import Frame, PlantArm, place
from gapbridge.drivers.simulated.plant.plant_settings import PlantSettings
from gapbridge.drivers.simulated.plant.rotations import (
    IDENTITY,
    Vector3,
    add,
    compose,
    cross,
    from_vector,
    rotate,
    scale,
    subtract,
    turn_z,
    unrotate,
)

MOVING = 0.02  # rad/s: above, the arm has left its place
RESTING = 0.005  # rad/s: below for REST_TIME, it has come to rest
REST_TIME = 0.05  # s
ITERATIONS = 60
CONVERGED = 1e-14  # rad


@dataclass(frozen=True, slots=True)
class Load:
    """What pulls at the arm: a payload on the flange and a wrench at the TCP, base axes."""

    mass: float  # kg
    cog: Vector3  # m, in the flange frame
    force: Vector3  # N
    torque: Vector3  # Nm


@dataclass(frozen=True, slots=True)
class Shape:
    """An arm under load: joint frames after bending, flange, moments about the joint origins."""

    frames: tuple[Frame, ...]  # n joints and the flange, in base
    moments: tuple[Vector3, ...]  # Nm, in the joint frames after bending


class Plant:
    """The arm's true state; advanced by the controller's cycle, measured by the bench."""

    def __init__(self, arm: PlantArm, settings: PlantSettings, q: Sequence[float]) -> None:
        self.arm = arm
        self.settings = settings
        self.q: tuple[float, ...] = tuple(float(v) for v in q)  # rad, joint encoders
        self.qd: tuple[float, ...] = (0.0,) * len(q)  # rad/s
        tip = add(settings.tcp[:3], settings.tool_shift)
        self.tool = Frame(from_vector(settings.tcp[3:]), tip)
        cog, wrench = settings.payload_cog, settings.wrench
        self.load = Load(settings.payload_mass, cog, wrench[:3], wrench[3:])
        self.zero: tuple[float, ...] = settings.zero or (0.0,) * len(q)
        self.placements = 0  # times that the arm has come to rest
        self._random = np.random.default_rng(settings.seed)
        self._moving = False
        self._still = 0.0
        self._bend: list[Vector3] = [(0.0, 0.0, 0.0)] * len(q)  # rad, where the servos hold it
        self.scatter: tuple[float, ...] = self._draw_scatter()

    def _draw_scatter(self) -> tuple[float, ...]:
        drawn = self._random.standard_normal(len(self.q))
        return tuple(float(s * d) for s, d in zip(self.settings.joint_scatter, drawn, strict=True))

    def step(self, target: Sequence[float], dt: float) -> None:
        """Let the joints follow `target` (n, rad) for `dt` s, with lag and within limits."""
        gain = 1.0 - math.exp(-dt / self.settings.servo_lag)
        most = self.settings.acceleration_limit * dt
        q, qd = [], []
        target = self._drooped_target(target)
        for now, speed, goal, limit in zip(self.q, self.qd, target, self.arm.velocity, strict=True):
            gap = goal - now
            if -1e-10 < gap < 1e-10 and -1e-4 < speed < 1e-4:
                q.append(goal)
                qd.append(0.0)
                continue
            wanted = gain * gap / dt
            wanted = min(max(wanted, speed - most), speed + most)
            wanted = min(max(wanted, -limit), limit)
            q.append(now + wanted * dt)
            qd.append(wanted)
        self.q, self.qd = tuple(q), tuple(qd)
        self._update_scatter(dt)

    def _drooped_target(self, target: Sequence[float]) -> Sequence[float]:
        """Return the joints (n, rad) at which the servos settle for `target`, with droop.

        Each call makes one iteration towards the equilibrium of the deflected arm: a cycle is too
        short for all, and an arm at rest converges within some cycles.
        """
        droop = self.settings.droop
        if not any(droop):
            return target
        moments = self._deflected(self.true_angles(), self._bend, self.load).moments
        self._bend = self._joint_deflections(moments)
        return tuple(t + c * m[2] for t, c, m in zip(target, droop, moments, strict=True))

    def _update_scatter(self, dt: float) -> None:
        """Draw a new placement error each time the arm comes to rest after a move."""
        fastest = max(map(abs, self.qd))
        if fastest > MOVING:
            self._moving, self._still = True, 0.0
        elif self._moving and fastest < RESTING:
            self._still += dt
            if self._still >= REST_TIME:
                self._moving, self._still = False, 0.0
                self.scatter = self._draw_scatter()
                self.placements += 1

    def true_angles(self) -> tuple[float, ...]:
        """Return the true joint angles (rad): encoders, zeros, the placement error."""
        return tuple(a + b + c for a, b, c in zip(self.q, self.scatter, self.zero, strict=True))

    def set_load(self, mass: float, cog: Vector3) -> None:
        """Set the load on the flange: kg, m in the flange frame."""
        self.load = replace(self.load, mass=mass, cog=cog)

    def set_force(self, force: Vector3, torque: Vector3) -> None:
        """Set force and torque at the TCP, in base axes: N, Nm."""
        self.load = replace(self.load, force=force, torque=torque)

    def slip(self, joint: int, angle: float) -> None:
        """Shift the zero of a joint (from 0): its true angle is ``angle`` rad more from now on."""
        zero = list(self.zero)
        zero[joint] += angle
        self.zero = tuple(zero)

    def shape(self, angles: Sequence[float], load: Load | None = None) -> Shape:
        """Return the equilibrium of the arm at joint `angles` (n, rad)."""
        load = self.load if load is None else load
        bend: list[Vector3] = [(0.0, 0.0, 0.0)] * len(angles)
        for _ in range(ITERATIONS):
            shape = self._deflected(angles, bend, load)
            new = self._joint_deflections(shape.moments)
            change = max(
                abs(a - b)
                for v, w in zip(new, bend, strict=True)
                for a, b in zip(v, w, strict=True)
            )
            bend = new
            if change < CONVERGED:
                break
        return shape

    def _joint_deflections(self, moments: Sequence[Vector3]) -> list[Vector3]:
        """Return the joint deflections (rad) under moments, in the joints' frames."""
        axial, radial = self.settings.axial, self.settings.radial
        return [
            (c_r * m[0], c_r * m[1], c_a * m[2])
            for m, c_a, c_r in zip(moments, axial, radial, strict=True)
        ]

    def _deflected(self, angles: Sequence[float], bend: Sequence[Vector3], load: Load) -> Shape:
        """Return frames and moments of the arm with given joint deflections."""
        frames: list[Frame] = []
        rotation, origin = IDENTITY, (0.0, 0.0, 0.0)
        for link, angle, turn in zip(self.arm.links, angles, bend, strict=False):
            origin = add(origin, rotate(rotation, link.origin))
            rotation = turn_z(compose(rotation, link.rotation), angle)
            rotation = compose(rotation, from_vector(turn))
            frames.append(Frame(rotation, origin))
        flange = place(frames[-1], self.arm.links[-1])
        return Shape((*frames, flange), self._moments(frames, flange, load))

    def _moments(self, frames: list[Frame], flange: Frame, load: Load) -> tuple[Vector3, ...]:
        """Return the moment of everything beyond each joint, in its own frame."""
        gravity = self.settings.gravity
        tip = add(flange.origin, rotate(flange.rotation, self.tool.origin))
        centre = add(flange.origin, rotate(flange.rotation, load.cog))
        weight = scale(gravity, load.mass)
        force = add(weight, load.force)
        # Moment about the base origin: the sum over everything beyond, moved to each joint below.
        moment = add(add(cross(centre, weight), cross(tip, load.force)), load.torque)
        moments: list[Vector3] = []
        for frame, mass, cog in zip(
            reversed(frames), reversed(self.arm.mass), reversed(self.arm.cog), strict=True
        ):
            pull = scale(gravity, mass)
            lever = add(frame.origin, rotate(frame.rotation, cog))
            force, moment = add(force, pull), add(moment, cross(lever, pull))
            here = subtract(moment, cross(frame.origin, force))
            moments.append(unrotate(frame.rotation, here))
        return tuple(reversed(moments))

    def true_tcp(self) -> Frame:
        """Return the true TCP in base."""
        return place(self.shape(self.true_angles()).frames[-1], self.tool)
