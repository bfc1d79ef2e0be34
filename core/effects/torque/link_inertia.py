"""A link heavier than in the model."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import JointEffect, Parameter, Term
from gapbridge.core.effects.simulator import Kind

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


class LinkInertia(JointEffect):
    """A link weighs more than in the model: its mass and inertia are scaled by 1 + value.

    Comes from cables, covers, another revision. Shows in the weight that the joints hold as well
    as in accelerations, on its own joint and on those before. Links beyond joint 1 need poses
    that change how they pull; link 1 turns about the vertical and shows in accelerations only.
    Links that keep their direction to each other (the last ones, with a payload) look alike.
    Source: Swevers, Verdonck, De Schutter, IEEE Control Systems 27 (2007) 58.
    """

    identifier = "link_inertia"
    title = "link weighs more or less"
    order = 20
    loads_joints = True
    adds_torque = True
    channels = ("torque",)
    simulated_as = Kind.LINK_SCALE
    motion = "many poses, and accelerations of all joints up to the link"
    # joint i is the one that turns link i
    fixed_parameters = (Parameter("", "", 0.05, -1.0, 20.0),)

    def drive(self, term: Term, arm: Arm, torque: Array, motion: Motion) -> Array:
        """Add the link's torques once more, scaled."""
        assert motion.pieces is not None
        return torque + term.values[0] * motion.pieces.link_torque[:, term.site.index]
