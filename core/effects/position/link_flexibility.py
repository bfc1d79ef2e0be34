"""Bending of links between their joints."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import Effect, Parameter, Site, Term, typical_moment

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.kernels.reference import Chain


class LinkFlexibility(Effect):
    """A link bends as a cantilever from its joint to the next, loaded at its far end.

    One EI a link; the parameter is 1/EI. Deflection F L^3/3EI + M L^2/2EI, slope F L^2/2EI + ML/EI;
    the link's own weight is left out. A near twin of the compliance of its two joints, separated
    by force and moment that change separately.
    Source: Euler-Bernoulli cantilever; Klimchik, Pashkevich, "Complete stiffness model".
    """

    identifier = "link_flexibility"
    title = "link bends under load"
    label_template = "bending of link {joint}"
    adds_up = True
    softens = True
    channels = ("position",)
    motion = "payloads or pulls in several directions, so that force and moment on the link differ"
    simulator_advice = (
        "add springs of 2 EI / L across the link at 21 % and 79 % of its length, a pair each"
    )

    def sites(self, arm: Arm) -> tuple[Site, ...]:
        """Return the links between two joints that have a length."""
        import numpy as np

        length = np.linalg.norm(arm.link_in_link[1 : arm.n, :3, 3], axis=1)
        return tuple(Site(joint=i + 1) for i in range(arm.n - 1) if length[i] > 1e-6)

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return 1/EI."""
        import numpy as np

        assert site.joint is not None
        length = max(float(np.linalg.norm(arm.link_in_link[site.joint, :3, 3])), 0.01)
        return (Parameter("", "1/(N m2)", 1e-3 / (typical_moment(arm) * length), 0.0),)

    def shape(self, term: Term, arm: Arm, chain: Chain) -> None:
        """Soften the link."""
        chain.flexibility[term.site.index] += term.values[0]
