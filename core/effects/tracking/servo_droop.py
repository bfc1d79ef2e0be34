"""Servos that give way under what they hold."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.effect import JointEffect, Parameter, Site, Term, typical_moment
from gapbridge.core.effects.simulator import Kind

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array


class ServoDroop(JointEffect):
    """The servo rests short of its target, by the torque it holds: actual_q = target_q - c tau.

    tau is the torque (Nm) that the joint holds about its axis at rest: gravity, payload and pull,
    positive where the motor pushes towards positive q. Comes from proportional position control
    without an integral part (hobby servos, CAN joint modules, impedance modes). Live, c tau is
    added to the setpoint. A constant error of the servo looks the same under one constant torque;
    a delay differs in that it goes by speed, not by load.
    Source: Siciliano et al., "Robotics" (2009), ch. 8.3: steady state of PD control without gravity
    compensation.
    """

    identifier = "servo_droop"
    title = "servo gives way under load"
    label_template = "droop of servo {joint} per torque"
    order = 60
    adds_up = True
    channels = ("tracking",)
    simulated_as = Kind.SERVO_COMPLIANCE
    motion = "poses, payloads or pulls that change the torque that the joint holds"
    equivalents: ClassVar = {"dead_band": "one torque at each joint, reached from one side"}

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the droop per torque."""
        held = typical_moment(arm, site.joint or 0)  # a wrist gives way to far less than a shoulder
        return (Parameter("", "rad/Nm", 5e-3 / held, 0.0, 1.0),)

    def settle(
        self,
        term: Term,
        arm: Arm,
        q: Array,
        held: Array,
        approach: Array | None,
    ) -> Array:
        """Let the joint give way."""
        i = term.site.index
        result = q.copy()
        result[:, i] -= term.values[0] * held[:, i]
        return result
