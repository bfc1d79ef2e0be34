"""First-order lag of joint servos."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import JointEffect, Parameter, Site, Term
from gapbridge.core.effects.simulator import Kind, SimulatorChange

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gapbridge.core.arm import Arm
    from gapbridge.core.motion import Motion


class TrackingLag(JointEffect):
    """The joint follows its command as a first-order lag: T dq/dt = target_q - q.

    Comes from the servo's bandwidth. Steady motion runs T qd behind; corners are rounded off,
    which is what separates it from pure latency. Exact: the lag's response to the command, which
    runs from row to row as a ramp (finer than the log where that is coarse), from where the
    encoder stood at first. A negative T, which only steps of a solver ask for, is continued oddly.
    Source: Astrom, Wittenmark, "Computer-Controlled Systems" (1997), ch. 2.
    """

    identifier = "tracking_lag"
    title = "joint lags behind"
    order = 30
    delays = True
    channels = ("tracking",)
    needs = ("timestamp",)
    motion = "a recording of the joint with accelerations, the sharper the better"
    instead = "filter the command in the control loop"

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the time constant."""
        return (Parameter("", "s", 5e-3, 0.0, 2.0),)

    def simulator(self, term: Term, arm: Arm) -> tuple[SimulatorChange, ...]:
        """Return it in a simulator's terms."""
        return (SimulatorChange(Kind.LAG, term.site.joint, term.values[0]),)

    def track(
        self, term: Term, arm: Arm, q: NDArray[np.float64], motion: Motion
    ) -> NDArray[np.float64]:
        """Let the joint follow."""
        assert term.site.joint is not None
        if not motion.moving:
            return q
        i, constant = term.site.joint - 1, term.values[0]
        from gapbridge.core.kernels.interpolation import lagged, stretches  # brings numba

        result = q.copy()
        for part in stretches(motion):
            command = q[part, i]
            late = lagged(motion.t[part], command, abs(constant), float(motion.q[part.start, i]))
            result[part, i] = late if constant >= 0 else 2 * command - late
        return result
