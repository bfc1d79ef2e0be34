"""Compliance of joints across their axes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import JointEffect, Parameter, Site, Term, typical_moment

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.kernels.rates import ChainRate
    from gapbridge.core.kernels.reference import Chain


class RadialCompliance(JointEffect):
    """The joint tilts across its axis, in proportion to the moment there: theta_r = C_r M_r.

    Comes from bearings and housings. At joint 1 it is the same as an isotropic tilt of the base.
    Source: Li, Gao, Liu 2020, eqs. 13 and 19-33 (our compensation core).
    """

    identifier = "radial_compliance"
    title = "joint tilts under load"
    label_template = "tilt of joint {joint} per moment"
    calibration_rank = 5
    softens = True
    flexibility = "radial"
    equals_sum_of = "base_compliance"
    channels = ("position",)
    motion = "payloads or pulls that change the moment across the joint's axis"
    simulator_advice = "add two joints with the spring 1/c across the axis"

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the flexibility beyond the model's."""
        return (Parameter("", "rad/Nm", 1e-3 / typical_moment(arm)),)

    def shape(self, term: Term, arm: Arm, chain: Chain) -> None:
        """Soften the joint about x and y alike."""
        chain.compliance[term.site.index, :2] += term.values[0]

    def shape_rate(self, term: Term, arm: Arm, chain: Chain, value: int, rate: ChainRate) -> bool:
        """Write the softer joint."""
        rate.compliance[term.site.index, :2] = 1.0
        return True
