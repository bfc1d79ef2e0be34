"""A flange sensor mounted askew."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import Effect, Parameter, Site, Term
from gapbridge.core.effects.simulator import Kind, SimulatorChange, along_axes

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


class FtMisalignment(Effect):
    """The flange sensor is turned against the flange: reading = R(r)^T wrench.

    r is the rotation vector of the sensor's axes in flange axes; force and torque turn alike,
    about the flange origin. Comes from a wrong bolt pattern or adapter. About z it looks like a
    joint offset of the last joint, which the encoders and a pose measurement separate.
    Source: Hollerbach, Khalil, Gautier, "Model Identification", Springer Handbook of
    Robotics (2016), ch. 6.
    """

    identifier = "ft_misalignment"
    title = "force sensor is turned"
    order = 55
    scales_reading = True
    identifiable_with = Term("payload", Site(), (1.0,))
    channels = ("wrench",)
    motion = "loads along at least two directions of the flange"
    simulator_advice = "turn the sensor's frame, or its readings"
    fixed_parameters = tuple(  # the rotation vector of the sensor in the flange
        Parameter(axis, "rad", 0.01, -math.pi, math.pi) for axis in ("rx", "ry", "rz")
    )

    def simulator(self, term: Term, arm: Arm) -> tuple[SimulatorChange, ...]:
        """Return it in a simulator's terms."""
        return along_axes(Kind.SENSOR_TURN, None, term.values)

    def sense(self, term: Term, arm: Arm, wrench: Array, motion: Motion) -> Array:
        """Express the wrench in the sensor's own axes."""
        import numpy as np

        from gapbridge.core.rotation import rotation_matrix

        R = rotation_matrix(np.array(term.values))
        return np.concatenate([wrench[:, :3] @ R, wrench[:, 3:] @ R], axis=1)
