"""The hidden parameters of the plant, and how they are drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.drivers.simulated.plant.plant_arm import PlantArm
from gapbridge.drivers.simulated.plant.rotations import Vector3

Vector6 = tuple[float, float, float, float, float, float]

TCP_REPEATABILITY = 4.0e-5  # m, rms length of the placement error with the arm stretched out


@dataclass(frozen=True, slots=True)
class PlantSettings:
    """Everything true about the plant that the controller does not say. SI units.

    axial, radial: joint compliances (n,), rad/Nm, about the joint's axis and across it.
    payload_mass, payload_cog: what really hangs on the flange, kg and m in the flange frame.
    tcp: TCP in the flange frame, x, y, z (m) and rotation vector (rad).
    wrench: outside pull at the TCP, base axes, N and Nm.
    gravity: in base, m/s^2.
    droop: how far each servo rests from its target per torque that it holds (n,), rad/Nm; empty:
        none gives way.
    zero: what each joint's true angle has more than its encoder says (n,), rad; empty: nothing.
    tool_shift: where the TCP really is beyond `tcp`, m, flange axes.
    servo_lag: time constant with which the joints follow the command, s.
    acceleration_limit: of every joint, rad/s^2.
    joint_scatter: placement error of each joint (n,), 1 sigma, rad, unseen by the encoder and
        drawn again whenever the arm comes to rest.
    force_noise, torque_noise: flange sensor, 1 sigma of one sample, N and Nm.
    sensor_bias: flange sensor, N and Nm in flange axes.
    joint_torque_noise: 1 sigma, Nm.
    ambient_temperature, temperature_rise, temperature_time: joints warm up from the first by the
        second with this time constant; °C, °C, s.
    tracker_noise, tracker_rotation_noise: the bench's laser tracker, 1 sigma of one coordinate,
        m and rad.
    seed: of all noise and of the placement errors.
    """

    axial: tuple[float, ...]
    radial: tuple[float, ...]
    payload_mass: float = 0.0
    payload_cog: Vector3 = (0.0, 0.0, 0.0)
    tcp: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    wrench: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    gravity: Vector3 = (0.0, 0.0, -9.80665)
    droop: tuple[float, ...] = ()
    zero: tuple[float, ...] = ()
    tool_shift: Vector3 = (0.0, 0.0, 0.0)
    servo_lag: float = 0.008
    acceleration_limit: float = 60.0
    joint_scatter: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    force_noise: float = 0.25
    torque_noise: float = 0.02
    sensor_bias: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    joint_torque_noise: float = 0.3
    ambient_temperature: float = 25.0
    temperature_rise: float = 9.0
    temperature_time: float = 1800.0
    tracker_noise: float = 2.0e-5
    tracker_rotation_noise: float = 3.0e-5
    seed: int = 0


def draw_plant_settings(arm: PlantArm, seed: int) -> PlantSettings:
    """Return a plausible plant for `arm`: base joints stiff, wrists soft, drawn from `seed`.

    Axial compliances come out of 3e-6..2e-5 rad/Nm, radial ones of 0.5e-6..4e-6 rad/Nm.
    """
    random = np.random.default_rng(seed)
    softness = np.linspace(0.15, 0.85, len(arm.mass))  # along the arm, on a scale of 0 to 1
    spread = random.uniform(-0.15, 0.15, (2, len(arm.mass)))
    axial = 3.0e-6 * (2.0e-5 / 3.0e-6) ** (softness + spread[0])
    radial = 0.5e-6 * (4.0e-6 / 0.5e-6) ** (softness + spread[1])
    scatter = TCP_REPEATABILITY / (0.5 * arm.reach * np.sqrt(3.0))
    bias = random.normal(0.0, 1.0, 6) * (4.0, 4.0, 4.0, 0.2, 0.2, 0.2)
    fx, fy, fz, tx, ty, tz = (float(b) for b in bias)
    return PlantSettings(
        axial=tuple(float(c) for c in axial),
        radial=tuple(float(c) for c in radial),
        joint_scatter=(float(scatter),) * len(arm.mass),
        sensor_bias=(fx, fy, fz, tx, ty, tz),
        seed=seed,
    )
