"""The records between layers: a sample of a controller's state, and a setpoint to it."""

from __future__ import annotations

from typing import NamedTuple

from gapbridge.core.arrays import Array

ENVELOPE, RATE, JOINT_OFFSET, JOINT_LIMIT, VELOCITY = range(5)
CLAMPS = ("envelope", "rate", "joint_offset", "joint_limit", "velocity")
"""What the limiter may clamp: the name of each bit of a setpoint's ``clamped``."""


class RobotState(NamedTuple):
    """One sample of a controller's state, all fields of the same cycle.

    Field names, units and frames are those of UR's RTDE guide (output names); a driver of another
    controller translates into them. A field that the controller does not have is None.
    A tuple, because one is made in every cycle: a frozen dataclass costs four times as much.
    """

    timestamp: float  # s, the controller's own clock
    received: float  # s, time.monotonic() when the sample was first seen here
    actual_q: Array  # (n,) rad, joint encoders
    actual_qd: Array  # (n,) rad/s
    target_q: Array  # (n,) rad, the controller's own joint command
    actual_TCP_force: Array  # (6,) N, Nm: surroundings on the tool, at the TCP, base axes
    ft_raw_wrench: Array | None = None  # (6,) N, Nm: flange sensor, flange axes
    joint_temperatures: Array | None = None  # (n,) °C
    actual_current_as_torque: Array | None = None  # (n,) Nm
    payload: float | None = None  # kg, declared in the controller
    payload_cog: Array | None = None  # (3,) m, in the flange frame
    robot_mode: int = 7  # RTDE robot_mode; 7 = running
    safety_mode: int = 1  # RTDE safety_mode; 1 = normal, 2 = reduced
    runtime_state: int = 2  # RTDE runtime_state; 2 = playing
    safety_status_bits: int = 1  # RTDE safety_status_bits; bit 0 = normal mode
    speed_scaling: float = 1.0
    sensor_lost: str = ""  # why the force is missing; actual_TCP_force is then NaN


class Setpoint(NamedTuple):
    """One corrected joint setpoint, as it leaves the limiter.

    ``offset_in_base`` is the same correction at the rigid arm's TCP: pose at ``q`` minus pose at
    ``nominal_q``, position (m) and rotation vector (rad) in base axes. Drivers whose controller
    takes a Cartesian offset send it instead of ``q``. A tuple, as RobotState is.
    """

    q: Array  # (n,) rad, the setpoint to be commanded
    nominal_q: Array  # (n,) rad, what was wanted before correction
    offset_in_base: Array  # (6,) m, rad
