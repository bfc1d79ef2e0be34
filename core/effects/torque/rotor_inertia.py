"""Inertia of motors and gears."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import Parameter, Site, Term, TorqueEffect, joint_scale
from gapbridge.core.effects.simulator import Kind

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


class RotorInertia(TorqueEffect):
    """The motor turns an inertia of its own, seen at the joint: + I qdd of that joint alone.

    The rotor's inertia times the square of the gear ratio; often as large as the arm's own and
    missing in URDFs. Needs accelerations; a link's inertia differs in that it also loads the
    joints before it and changes with the pose.
    Source: Siciliano et al., "Robotics" (2009), ch. 7; MuJoCo's ``armature``.
    """

    identifier = "rotor_inertia"
    title = "motor inertia is missing"
    order = 30
    adds_up = True
    simulated_as = Kind.ARMATURE
    motion = "accelerations of the joint, at several poses of those beyond"
    simulator_advice = "set the joint's armature where the simulator has it"

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the inertia at the joint's side of the gear."""
        scale = max(1e-2 * joint_scale(arm, site), 1e-3)
        return (Parameter("", "kg m2", scale, 0.0, math.inf),)

    def added(self, term: Term, i: int, motion: Motion) -> Array:
        """Return what accelerates the rotor."""
        return term.values[0] * motion.qdd[:, i]
