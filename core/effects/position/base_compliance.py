"""A foundation that gives way."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import Effect, Parameter, Site, Term, typical_moment

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.kernels.rates import ChainRate
    from gapbridge.core.kernels.reference import Chain


class BaseCompliance(Effect):
    """The foundation tilts under the moment that the arm puts on it, about x and y of base.

    Comes from pedestals, carts, mounting plates. Two flexibilities, because a pedestal is rarely
    as stiff sideways as lengthways; where both are equal it is the same as the radial compliance of
    a joint 1 whose frame stands in the base's origin.
    Source: prior art on flexible mounting (FIGAROH's base suspension example).
    """

    identifier = "base_compliance"
    title = "foundation gives way"
    label_template = "yielding of the foundation about {part}"
    adds_up = True
    softens = True
    channels = ("position",)
    motion = "poses and payloads that change the moment on the base, in all directions around it"
    simulator_advice = "put the base on springs about x and y"

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the flexibilities about x and y of base."""
        scale = 1e-3 / typical_moment(arm)
        return (Parameter("x", "rad/Nm", scale, 0.0), Parameter("y", "rad/Nm", scale, 0.0))

    def shape(self, term: Term, arm: Arm, chain: Chain) -> None:
        """Soften the base."""
        chain.base_compliance[:2] += term.values

    def shape_rate(self, term: Term, arm: Arm, chain: Chain, value: int, rate: ChainRate) -> bool:
        """Write the softer base."""
        rate.base_compliance[value] = 1.0
        return True
