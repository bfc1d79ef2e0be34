"""What the controller measures and derives each cycle: poses, forces, torques, temperatures."""

from __future__ import annotations

import math
from collections.abc import MutableMapping
from typing import Any

import numpy as np

from gapbridge.drivers.simulated.plant.declared_settings import DeclaredSettings
from gapbridge.drivers.simulated.plant.kinematics import gap, holding_torque, pose_of
from gapbridge.drivers.simulated.plant.plant import Plant
from gapbridge.drivers.simulated.plant.plant_arm import Frame, place
from gapbridge.drivers.simulated.plant.rotations import (
    IDENTITY,
    Vector3,
    add,
    compose,
    cross,
    rotate,
    scale,
    subtract,
    transpose,
    unrotate,
)

NOISE_BATCH = 250  # rows drawn at once
SLOW_EVERY = 10  # cycles between the costly fields
TORQUE_PER_AMPERE = 11.0  # Nm/A, about that of the larger joints

_ZERO6 = (0.0,) * 6


class Sensors:
    """Fills the measured fields of the controller's memory.

    ``update`` runs in every cycle and costs tens of microseconds; ``update_slowly`` runs after
    the packets have left and does what needs the plant's equilibrium.
    """

    def __init__(
        self, plant: Plant, declared: DeclaredSettings, memory: MutableMapping[str, Any]
    ) -> None:
        self._plant = plant
        self._declared = declared
        self._memory = memory
        self._random = np.random.default_rng((plant.settings.seed, 1))
        self._noise: list[list[float]] = []
        self._zero = plant.settings.sensor_bias  # subtracted from actual_TCP_force; set by zeroFt
        self._bend = IDENTITY  # true flange in the rigid one
        self._bent_at: object = None
        self._wrench: tuple[float, ...] = (0.0,) * len(plant.q)
        self._flange = plant.arm.flange(plant.q)
        self._centres: list[Vector3] = []
        self._q: tuple[float, ...] | None = None
        self._target: tuple[float, ...] | None = None
        self._tool: Frame | None = None
        self._poses: dict[str, Frame] = {}
        self._count = 0
        self.update_slowly(0.0)

    def update(self, target_q: tuple[float, ...], dt: float) -> None:
        """Refresh the fields of this cycle."""
        memory, plant, tool = self._memory, self._plant, self._declared.tool
        if plant.q is not self._q or tool is not self._tool:
            self._flange = plant.arm.flange(plant.q)
            self._track("actual", place(self._flange, tool), dt)
            self._q = plant.q
        else:
            memory["actual_TCP_speed"] = _ZERO6
        if target_q != self._target or tool is not self._tool:
            self._track("target", place(plant.arm.flange(target_q), tool), dt)
            self._target = target_q
        else:
            memory["target_TCP_speed"] = _ZERO6
        self._tool = tool
        self._sense_force(dt)

    def _track(self, which: str, tcp: Frame, dt: float) -> None:
        """Set a TCP pose and the speed with which it came there."""
        before = self._poses.get(which)
        step = gap(before, tcp) if before is not None else _ZERO6
        self._poses[which] = tcp
        self._memory[f"{which}_TCP_pose"] = pose_of(tcp)
        self._memory[f"{which}_TCP_speed"] = tuple(v / dt for v in step)

    def _draw_noise(self) -> None:
        """Draw the noise of the next cycles: force (3), torque (3), joint torques (n)."""
        s = self._plant.settings
        n = len(self._plant.q)
        size = (3 * (s.force_noise,), 3 * (s.torque_noise,), n * (s.joint_torque_noise,))
        drawn = self._random.standard_normal((NOISE_BATCH, 6 + n)) * np.concatenate(size)
        self._noise = drawn.tolist()

    def _sense_force(self, dt: float) -> None:
        """Set ft_raw_wrench (flange axes) and actual_TCP_force (base axes, payload taken off)."""
        if not self._noise:
            self._draw_noise()
        plant, memory, noise = self._plant, self._memory, self._noise.pop()
        load, r = plant.load, self._flange.rotation
        sensor = compose(r, self._bend)
        pull = self._apparent_gravity(dt)
        weight = scale(pull, load.mass)
        arm = rotate(sensor, load.cog)
        tip = rotate(sensor, plant.tool.origin)
        torque = add(add(cross(arm, weight), cross(tip, load.force)), load.torque)
        f = unrotate(sensor, add(weight, load.force))
        t = unrotate(sensor, torque)
        bias, zero = plant.settings.sensor_bias, self._zero
        sensed = [v + b + e for v, b, e in zip((*f, *t), bias, noise, strict=False)]
        memory["ft_raw_wrench"] = tuple(sensed)
        force = self._at_tcp([v - z for v, z in zip(sensed, zero, strict=True)], pull)
        memory["actual_TCP_force"] = force
        memory["tcp_force_scalar"] = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
        memory["actual_tool_accelerometer"] = unrotate(r, scale(pull, -1.0))
        memory["actual_current_as_torque"] = torques = tuple(
            a + b for a, b in zip(self._wrench, noise[6:], strict=True)
        )
        memory["actual_current"] = tuple(v / TORQUE_PER_AMPERE for v in torques)

    def _at_tcp(self, sensed: list[float], pull: Vector3) -> tuple[float, ...]:
        """Return the sensed wrench without the declared payload, at the declared TCP, base axes."""
        declared, r = self._declared, self._flange.rotation
        weight = scale(pull, declared.payload_mass)
        force = subtract(rotate(r, sensed[:3]), weight)
        torque = subtract(rotate(r, sensed[3:]), cross(rotate(r, declared.payload_cog), weight))
        torque = subtract(torque, cross(rotate(r, declared.tool.origin), force))
        return (*force, *torque)

    def _apparent_gravity(self, dt: float) -> Vector3:
        """Return gravity less the payload's acceleration, base axes, m/s^2."""
        gravity = self._plant.settings.gravity
        centres = self._centres
        here = add(self._flange.origin, rotate(self._flange.rotation, self._plant.load.cog))
        centres.append(here)
        if len(centres) < 3:
            return gravity
        a, b, c = centres[-3:]
        del centres[:-2]
        if a is c or a == b == c:
            return gravity
        k = 1.0 / (dt * dt)
        return (
            gravity[0] - k * (a[0] - 2.0 * b[0] + c[0]),
            gravity[1] - k * (a[1] - 2.0 * b[1] + c[1]),
            gravity[2] - k * (a[2] - 2.0 * b[2] + c[2]),
        )

    def zero(self) -> None:
        """Take the present reading, less the declared payload, as zero (zero_ftsensor)."""
        declared, r = self._declared, self._flange.rotation
        weight = unrotate(r, scale(self._plant.settings.gravity, declared.payload_mass))
        torque = cross(declared.payload_cog, weight)
        sensed = self._memory["ft_raw_wrench"]
        a, b, c, d, e, f = (v - w for v, w in zip(sensed, (*weight, *torque), strict=True))
        self._zero = (a, b, c, d, e, f)

    def after_cycle(self, clock: float) -> None:
        """Refresh the costly fields every few cycles; called when the packets have left."""
        self._count += 1
        if not self._noise:
            self._draw_noise()
        if self._count >= SLOW_EVERY:
            self._count = 0
            self.update_slowly(clock)

    def update_slowly(self, clock: float) -> None:
        """Refresh what needs the equilibrium or changes slowly."""
        plant, memory, declared = self._plant, self._memory, self._declared
        key = (
            plant.q, plant.scatter, plant.zero, plant.load, declared.tool, declared.payload_mass
        )  # fmt: skip
        if key != self._bent_at:
            self._bent_at = key
            angles = plant.true_angles()
            true = plant.shape(angles).frames[-1]
            self._bend = compose(transpose(plant.arm.flange(plant.q).rotation), true.rotation)
            self._set_torques()
        s = plant.settings
        share = 1.0 - math.exp(-clock / s.temperature_time)
        rise = s.temperature_rise * share
        memory["joint_temperatures"] = tuple(
            s.ambient_temperature + rise * (0.7 + 0.1 * i) for i in range(len(plant.q))
        )
        memory["tool_temperature"] = s.ambient_temperature + 0.8 * rise

    def _set_torques(self) -> None:
        """Set the joint torques: measured (true) and target (the controller's model)."""
        plant, memory, declared = self._plant, self._memory, self._declared
        load, s = plant.load, plant.settings
        pull = (*load.force, *load.torque)
        self._wrench = holding_torque(
            plant.arm, plant.true_angles(), s.gravity, load.mass, load.cog, pull, plant.tool
        )
        reckoned = holding_torque(
            plant.arm, plant.q, s.gravity, declared.payload_mass, declared.payload_cog,
            _ZERO6, declared.tool,
        )  # fmt: skip
        memory["target_moment"] = memory["joint_control_output"] = reckoned
        memory["target_current"] = tuple(v / TORQUE_PER_AMPERE for v in reckoned)
        memory["elbow_position"] = plant.arm.frames(plant.q)[2].origin
