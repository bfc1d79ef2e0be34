"""Friction that grows with speed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.effect import Parameter, Site, Term, TorqueEffect, joint_scale
from gapbridge.core.effects.simulator import Kind

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


class ViscousFriction(TorqueEffect):
    """The motor delivers a torque more that grows with speed: + c qd.

    Comes from grease and damping; colder joints have more. Needs several speeds, else it is the
    same as Coulomb friction.
    Source: Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994) 1083.
    """

    identifier = "viscous_friction"
    title = "friction grows with speed"
    order = 51
    adds_up = True
    simulated_as = Kind.DAMPING
    estimated_with_links = True
    motion = "the joint moved at several speeds"
    equivalents: ClassVar = {"coulomb_friction": "motion at one speed"}

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the coefficient."""
        return (Parameter("", "Nm s/rad", 0.03 * joint_scale(arm, site), 0.0, math.inf),)

    def added(self, term: Term, i: int, motion: Motion) -> Array:
        """Return the friction that the motor overcomes."""
        return term.values[0] * motion.qd[:, i]
