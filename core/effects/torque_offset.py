"""A torque reading whose zero is off."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.coulomb_friction import joint_scale
from gapbridge.core.effects.effect import JointEffect, Parameter, Site, Term

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gapbridge.core.arm import Arm
    from gapbridge.core.motion import Motion


class TorqueOffset(JointEffect):
    """The measured torque of a joint is a constant too much: measured = torque + offset.

    Comes from the zero of a current or torque sensor, and from friction that differs by direction:
    half its difference looks the same. Joints whose weight never changes show a link's first moment
    as an offset; motion both ways separates it from Coulomb friction.
    Source: Hollerbach, Khalil, Gautier, "Model Identification", Springer Handbook of Robotics
    (2016), ch. 6.
    """

    identifier = "torque_offset"
    title = "torque reading's zero is off"
    label_words = "zero of the torque of joint {joint}"
    order = 95
    channels = ("torque",)
    motion = "the joint moved both ways, at poses that change its weight"
    alike: ClassVar = {
        "coulomb_friction": "motion of the joint one way only",
        "link_cog": "a joint whose weight never changes",
    }
    instead = "subtract the offset from the measured torque before it is compared"

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the offset."""
        return (Parameter("", "Nm", 0.02 * joint_scale(arm, site)),)

    def drive(
        self, term: Term, arm: Arm, torque: NDArray[np.float64], motion: Motion
    ) -> NDArray[np.float64]:
        """Add the offset."""
        assert term.site.joint is not None
        result = torque.copy()
        result[:, term.site.joint - 1] += term.values[0]
        return result
