"""Pure delay between command and motion."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import Parameter, ServoEffect, Term
from gapbridge.core.effects.simulator import Kind

if TYPE_CHECKING:
    from gapbridge.core.arrays import Array


class Latency(ServoEffect):
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
    adds_up = True
    is_delay = True
    simulated_as = Kind.DELAY
    needs = ("timestamp",)
    motion = "a recording of changing speeds of the joint"
    simulator_advice = "delay the command in the control loop"
    fixed_parameters = (Parameter("", "s", 5e-3, 0.0, 2.0),)

    def follow(self, term: Term, time: Array, command: Array, first: float) -> Array:
        """Look the command up in the past."""
        from gapbridge.core.kernels.interpolation import interpolate  # brings numba

        return interpolate(time, command, time - term.values[0])
