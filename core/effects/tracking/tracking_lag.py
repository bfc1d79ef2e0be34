"""First-order lag of joint servos."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import Parameter, ServoEffect, Term
from gapbridge.core.effects.simulator import Kind

if TYPE_CHECKING:
    from gapbridge.core.arrays import Array


class TrackingLag(ServoEffect):
    """The joint follows its command as a first-order lag: T dq/dt = target_q - q.

    Comes from the servo's bandwidth. Steady motion runs T qd behind; corners are rounded off,
    which is what separates it from pure latency. Exact: the lag's response to the command, which
    runs from row to row as a ramp (finer than the log where that is coarse), from where the
    encoder stood at first. A negative T occurs in a solver's steps only: the odd continuation.
    Source: Astrom, Wittenmark, "Computer-Controlled Systems" (1997), ch. 2.
    """

    identifier = "tracking_lag"
    title = "joint lags behind"
    order = 30
    adds_up = True
    is_delay = True
    simulated_as = Kind.LAG
    needs = ("timestamp",)
    motion = "a recording of the joint with accelerations, the sharper the better"
    simulator_advice = "filter the command in the control loop"
    fixed_parameters = (Parameter("", "s", 5e-3, 0.0, 2.0),)  # time constant

    def follow(self, term: Term, time: Array, command: Array, first: float) -> Array:
        """Let the joint follow."""
        from gapbridge.core.kernels.interpolation import lagged  # brings numba

        late = lagged(time, command, abs(term.values[0]), first)
        return late if term.values[0] >= 0 else 2 * command - late
