"""Joints that stiffen under load."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import (
    JointEffect,
    Parameter,
    Reported,
    Site,
    Term,
    typical_moment,
)

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.kernels.rates import ChainRate
    from gapbridge.core.kernels.reference import Chain


class StiffnessNonlinearity(JointEffect):
    """The joint stiffens under load: theta = c M / sqrt(1 + (M / M0)^2) about its axis.

    Comes from strain-wave gears, whose teeth engage further under torque. It holds the linear part
    too, so it stands instead of the joint's ``axial_compliance``. Needs several loads: with one, it
    looks like a linear compliance.
    Source: stiffening curves of harmonic drives in makers' catalogues (K1 < K2 < K3).
    """

    identifier = "stiffness_nonlinearity"
    title = "joint stiffens under load"
    label_template = "stiffening of joint {joint} ({part})"
    adds_up = True
    softens = True
    has_nonlinearity = True
    replaces = "axial_compliance"
    channels = ("position",)
    motion = "at least three well separated torques about the joint's axis"
    simulator_advice = "add a joint with the spring 1/c + theta^2 / (2 c^3 M0^2)"

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return c and the softening 1/M0^2, in which the curve starts linear."""
        own = typical_moment(arm, site.joint or 0)  # a wrist's curve bends at far less
        return (
            Parameter("compliance", "rad/Nm", 1e-3 / typical_moment(arm), 0.0),
            Parameter("softening", "1/(Nm)2", 1 / own**2, 0.0),
        )

    def shape(self, term: Term, arm: Arm, chain: Chain) -> None:
        """Soften the joint about z by the bent curve."""
        i = term.site.index
        chain.compliance[i, 2] += term.values[0]
        chain.softening[i] += term.values[1]

    def shape_rate(self, term: Term, arm: Arm, chain: Chain, value: int, rate: ChainRate) -> bool:
        """Write the softer joint, or the bent curve."""
        i = term.site.index
        if value == 0:
            rate.compliance[i, 2] = 1.0
        else:
            rate.softening[i] = 1.0
        return True

    def reported(self, arm: Arm, term: Term, covariance: Array | None) -> tuple[Reported, ...]:
        """Return c and M0."""
        c, softening = term.values
        moment = 1 / math.sqrt(softening) if softening > 0 else float("inf")
        spread: list[float | None] = [None, None]
        if covariance is not None:
            derivative = 0.5 * moment**3 if math.isfinite(moment) else float("inf")
            deviation = [math.sqrt(max(v, 0.0)) for v in covariance.diagonal()]
            spread = [deviation[0], deviation[1] * derivative]
        base = f"{self.identifier}_{term.site.joint}"
        return (
            Reported(f"{base}_compliance", c, spread[0], "rad/Nm", "compliance"),
            Reported(f"{base}_moment", moment, spread[1], "Nm", "moment"),
        )
