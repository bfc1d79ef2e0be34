"""Servos that stop before they are there."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.effect import Parameter, ServoEffect, Term

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array


class DeadBand(ServoEffect):
    """The servo rests within w of its target and moves again only once it is further off.

    Coming from below it rests at target - w, from above at target + w; in motion it is play of half
    width w between target and actual. Comes from controllers that ignore small errors, and from dry
    friction that a proportional servo does not overcome. Live, the setpoint goes w further in the
    direction of the joint's last motion. Needs motion both ways: one way only it looks like a
    constant error of the servo. A lag goes by speed, a dead band does not.
    Source: Tao, Kokotovic, "Adaptive Control of Systems with Actuator and Sensor Nonlinearities"
    (1996), ch. 2, backlash.
    """

    identifier = "dead_band"
    title = "servo stops before its target"
    label_template = "dead band of servo {joint}"
    order = 70
    adds_up = True
    depends_on_approach = True
    motion = "the joint moved both ways, or poses reached from both sides"
    equivalents: ClassVar = {
        "latency": "motion one way at one speed",
        "tracking_lag": "motion one way at one speed",
    }
    simulator_advice = "in the controller's settings, or a second, limited joint behind each servo"
    fixed_parameters = (Parameter("", "rad", 1e-3, 0.0, 0.2),)  # the half width w

    def follow(self, term: Term, time: Array, command: Array, first: float) -> Array:
        """Move the joint only where its target has left the band."""
        from gapbridge.core.kernels.interpolation import played  # brings numba

        return played(command, term.values[0], first)

    def settle(
        self,
        term: Term,
        arm: Arm,
        q: Array,
        held: Array,
        approach: Array | None,
    ) -> Array:
        """Let the joint rest on the side that it came from."""
        if approach is None:
            return q
        i = term.site.index
        result = q.copy()
        result[:, i] -= term.values[0] * approach[:, i]
        return result
