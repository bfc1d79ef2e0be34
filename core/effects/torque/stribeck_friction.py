"""Friction that is higher just after the joint breaks away."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.effect import Parameter, Site, Term, TorqueEffect, joint_scale

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion

SLOWEST = 1e-4  # rad/s


class StribeckFriction(TorqueEffect):
    """The motor delivers more at low speed: + (F_s - F_c) exp(-(qd / v_s)^2) sign(qd).

    Above the Coulomb friction, which it comes on top of; v_s is the speed at which a film of grease
    has built up. Needs slow motion: rows in which the direction is unsure count smoothly, and a log
    without speeds near v_s shows nothing of it. At one speed it is the same as Coulomb friction.
    Source: Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994) 1083.
    """

    identifier = "stribeck_friction"
    title = "friction is higher at low speed"
    label_template = "breakaway friction of joint {joint} {part}"
    order = 54
    motion = "the joint moved both ways, slowly and fast"
    equivalents: ClassVar = {"coulomb_friction": "motion at one low speed"}
    simulator_advice = "friction by speed in the control loop, or the simulator's actuator"
    start_values = tuple(4e-3 * 150 ** (i / 8) for i in range(9))  # rad/s

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the torque at standstill above Coulomb's, and the speed at which it is gone."""
        return (
            Parameter("", "Nm", 0.03 * joint_scale(arm, site), 0.0, math.inf),
            Parameter("velocity", "rad/s", 0.05, 0.0, 10.0),
        )

    def added(self, term: Term, i: int, motion: Motion) -> Array:
        """Return the friction that the motor overcomes."""
        import numpy as np

        speed = max(abs(term.values[1]), SLOWEST)
        fading = np.exp(-((motion.qd[:, i] / speed) ** 2))
        return term.values[0] * fading * motion.direction_of(i)
