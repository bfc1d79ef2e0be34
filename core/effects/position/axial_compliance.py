"""Compliance of joints about their axes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import JointEffect, Parameter, Site, Term, typical_moment

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.kernels.rates import ChainRate
    from gapbridge.core.kernels.reference import Chain


class AxialCompliance(JointEffect):
    """The joint gives way about its own axis, in proportion to the torque: theta_a = C_a M_a.

    Comes from gears and shafts. Needs poses, or better loads, that change the joint's torque. A
    vertical joint 1 carries no torque by weight: only a sideways pull shows it.
    Source: Li, Gao, Liu 2020, eqs. 13-18 (our compensation core).
    """

    identifier = "axial_compliance"
    title = "joint twists under load"
    label_template = "twist of joint {joint} per torque"
    calibration_rank = 4
    softens = True
    flexibility = "axial"
    channels = ("position",)
    motion = "payloads or pulls that change the torque about the joint's axis"
    simulator_advice = "add a joint with the spring 1/c about the same axis"

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the flexibility beyond the model's."""
        return (Parameter("", "rad/Nm", 1e-3 / typical_moment(arm)),)

    def shape(self, term: Term, arm: Arm, chain: Chain) -> None:
        """Soften the joint about z."""
        chain.compliance[term.site.index, 2] += term.values[0]

    def shape_rate(self, term: Term, arm: Arm, chain: Chain, value: int, rate: ChainRate) -> bool:
        """Write the softer joint."""
        rate.compliance[term.site.index, 2] = 1.0
        return True
