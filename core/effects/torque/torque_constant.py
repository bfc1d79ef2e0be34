"""Torque that is measured on a wrong scale."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.effect import JointEffect, Parameter, Term

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


class TorqueConstant(JointEffect):
    """The measured torque of a joint is scaled: measured = (1 + value) torque.

    Torque is motor current times a constant that falls with temperature and differs from motor to
    motor. Scales everything that the joint delivers, weight, inertia and friction alike.
    Source: Gautier, Briot, "Global identification of joint drive gains", ASME JDSMC 136 (2014).
    """

    identifier = "torque_constant"
    title = "torque reading is scaled"
    order = 90
    scales_reading = True
    channels = ("torque",)
    motion = "a joint that carries torque, the more changing the better"
    equivalents: ClassVar = {"torque_offset": "motion in which the joint's torque never changes"}
    simulator_advice = "scale the measured torque by 1 / (1 + value) before it is compared"
    # limited to half: a larger one replaces friction and first moments (KUKA KR 300, UR10e)
    fixed_parameters = (Parameter("", "", 0.05, -0.5, 0.5),)

    def drive(self, term: Term, arm: Arm, torque: Array, motion: Motion) -> Array:
        """Scale the joint's torque."""
        result = torque.copy()
        result[:, term.site.index] *= 1.0 + term.values[0]
        return result
