"""A torque reading whose zero is off."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.effect import Parameter, Site, Term, TorqueEffect, joint_scale

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


class TorqueOffset(TorqueEffect):
    """The measured torque of a joint is a constant too much: measured = torque + offset.

    Comes from the zero of a current or torque sensor, and from friction that differs by direction:
    half its difference looks the same. Joints whose weight never changes show a link's first moment
    as an offset; motion both ways separates it from Coulomb friction.
    Source: Hollerbach, Khalil, Gautier, "Model Identification", Springer Handbook of Robotics
    (2016), ch. 6.
    """

    identifier = "torque_offset"
    title = "torque reading's zero is off"
    label_template = "zero of the torque of joint {joint}"
    order = 95
    estimated_with_links = True
    motion = "the joint moved both ways, at poses that change its weight"
    equivalents: ClassVar = {
        "coulomb_friction": "motion of the joint one way only",
        "link_cog": "a joint whose weight never changes",
    }
    simulator_advice = "subtract the offset from the measured torque before it is compared"

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the offset."""
        return (Parameter("", "Nm", 0.02 * joint_scale(arm, site)),)

    def added(self, term: Term, i: int, motion: Motion) -> Array:
        """Return the offset."""
        import numpy as np

        return np.full(len(motion.q), term.values[0])
