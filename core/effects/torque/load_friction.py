"""Friction that grows with load."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.effect import Parameter, Term, TorqueEffect

if TYPE_CHECKING:
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


class LoadFriction(TorqueEffect):
    """The motor delivers a torque more that grows with the joint's load: + mu |tau_load| sign(qd).

    tau_load is the inverse dynamics of the rigid arm with payload and pull, without friction and
    rotor. Comes from gears that lose a share of what they transmit. At one load it is the same as
    Coulomb friction: poses or payloads that change the load, with motion both ways, separate them.
    Near standstill the direction counts smoothly, as for Coulomb friction.
    Source: Hamon, Gautier, Garrec, "Dynamic identification of robots with a dry friction model
    depending on load and velocity", IROS (2010).
    """

    identifier = "load_friction"
    title = "friction grows with load"
    label_template = "load friction of joint {joint}"
    order = 53
    adds_up = True
    depends_on_load = True
    motion = "the joint moved both ways under loads that change"
    equivalents: ClassVar = {"coulomb_friction": "motion under one load"}
    simulator_advice = "friction by load in the control loop, or the simulator's actuator"
    fixed_parameters = (Parameter("", "", 0.05, 0.0, 5.0),)  # share of the load

    def added(self, term: Term, i: int, motion: Motion) -> Array:
        """Return the friction that the motor overcomes."""
        import numpy as np

        assert motion.load is not None
        return term.values[0] * np.abs(motion.load[:, i]) * motion.direction_of(i)
