"""Zero offsets of joint encoders."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import JointEffect, Parameter, Site, Term
from gapbridge.core.effects.simulator import Kind

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.kernels.reference import Rows
    from gapbridge.core.loads import Loads


class JointOffset(JointEffect):
    """The encoder's zero differs from the model's: true angle = ``actual_q`` + offset.

    Comes from mastering, a changed motor, a collision. Shows as a rotation of everything beyond the
    joint about its axis, the same at every pose and load. Joint 1 hides behind an unregistered
    metrology frame, the last joint behind the tool.
    Source: mastering and level-1 calibration, Mooring, Roth, Driels, "Fundamentals of Manipulator
    Calibration" (1991), ch. 1.
    """

    identifier = "joint_offset"
    title = "joint zero is off"
    label_template = "zero of joint {joint}"
    calibration_rank = 2
    verification_message = "the zero of joint {joint} moved by {size}"
    estimated_with_links = True
    channels = ("position",)
    simulated_as = Kind.JOINT_ZERO
    motion = "poses that differ in the other joints"
    fixed_parameters = (Parameter("", "rad", 1e-3, -0.5, 0.5),)

    def angle_columns(self, site: Site, q: Array) -> Array:
        """Return ones: the same turn at every angle."""
        import numpy as np

        return np.ones((len(q), 1))

    def condition(self, term: Term, arm: Arm, rows: Rows, loads: Loads, q: Array) -> None:
        """Turn the joint further."""
        rows.q[:, term.site.index] += term.values[0]
