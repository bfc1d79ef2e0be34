"""Pure delay between command and motion."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import JointEffect, Parameter, Site, Term
from gapbridge.core.effects.simulator import Kind, SimulatorChange

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gapbridge.core.arm import Arm
    from gapbridge.core.motion import Motion


class Latency(JointEffect):
    """The joint does what it was commanded, but later: actual_q(t) = target_q(t - latency).

    Comes from communication, buffering, interpolation. A delay of the whole arm shows as the same
    delay at every joint that moved; reported per joint, because one joint's drive can have it alone
    and a joint that stood still cannot show it. Differs from a lag in that corners stay sharp: only
    fast changes of the command separate the two, slow motion gives their sum.
    Exact: the command is interpolated by a cubic spline at t - latency. Rows
    right after the start of a recording, or after a gap, hold the first command.
    Source: Astrom, Wittenmark, "Computer-Controlled Systems" (1997), ch. 2.
    """

    identifier = "latency"
    title = "joint reacts late"
    order = 20
    delays = True
    channels = ("tracking",)
    needs = ("timestamp",)
    motion = "a recording of changing speeds of the joint"
    instead = "delay the command in the control loop"

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the delay."""
        return (Parameter("", "s", 5e-3, 0.0, 2.0),)

    def simulator(self, term: Term, arm: Arm) -> tuple[SimulatorChange, ...]:
        """Return it in a simulator's terms."""
        return (SimulatorChange(Kind.DELAY, term.site.joint, term.values[0]),)

    def track(
        self, term: Term, arm: Arm, q: NDArray[np.float64], motion: Motion
    ) -> NDArray[np.float64]:
        """Look the command up in the past."""
        assert term.site.joint is not None
        if not motion.moving:
            return q
        i = term.site.joint - 1
        from gapbridge.core.kernels.interpolation import interpolate, stretches  # brings numba

        result = q.copy()
        for part in stretches(motion):
            time = motion.t[part]
            result[part, i] = interpolate(time, q[part, i], time - term.values[0])
        return result
