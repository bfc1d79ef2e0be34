"""Dry friction of joints."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import Parameter, Site, Term, TorqueEffect, joint_scale
from gapbridge.core.effects.simulator import Kind

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


class CoulombFriction(TorqueEffect):
    """The motor delivers a constant torque more, along the motion: + F sign(qd).

    Comes from seals, bearings, gear mesh. At rest the friction may be anything up to F, so rows in
    which the direction is unsure count smoothly: F tanh(4 qd / band), with the band from the noise
    and the speed of the log. Needs motion both ways: one way only it looks like a constant torque.
    Several speeds separate it from viscous friction.
    Source: Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994) 1083.
    """

    identifier = "coulomb_friction"
    title = "constant friction"
    order = 52
    adds_up = True
    simulated_as = Kind.FRICTION
    estimated_with_links = True
    motion = "the joint moved both ways"

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the torque."""
        return (Parameter("", "Nm", 0.03 * joint_scale(arm, site), 0.0, math.inf),)

    def added(self, term: Term, i: int, motion: Motion) -> Array:
        """Return the friction that the motor overcomes."""
        return term.values[0] * motion.direction_of(i)
