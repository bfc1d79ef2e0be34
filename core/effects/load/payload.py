"""A payload that weighs more than declared."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.effect import Effect, Parameter, Term
from gapbridge.core.effects.simulator import Kind

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.kernels.reference import Rows
    from gapbridge.core.loads import Loads
    from gapbridge.core.motion import Motion


class Payload(Effect):
    """The load weighs more than declared: true payload = declared + this, at its declared cog.

    Comes from a wrong entry, a tool that was left out, a hose. Shows as bending (position), as
    weight (flange sensor) and as torque; positions of a rigid model do not show it.
    """

    identifier = "payload"
    title = "load weighs more or less than declared"
    label_template = "mass of the load beyond the declared one"
    order = 10
    acts_through_deflection = True
    adds_mass = True
    loads_joints = True
    replaces_cell_value = "payload"
    verification_message = "the load differs from what was declared by {size}"
    channels = ("position", "wrench", "torque")
    simulated_as = Kind.PAYLOAD
    motion = "poses that change how the load pulls"
    equivalents: ClassVar = {"ft_bias": "a flange that never turns against gravity"}
    simulator_advice = "change the load's mass where it is modelled"
    fixed_parameters = (Parameter("", "kg", 1.0),)  # the extra mass

    def condition(self, term: Term, arm: Arm, rows: Rows, loads: Loads, q: Array) -> None:
        """Add the mass."""
        rows.payload_mass[:] += term.values[0]

    def sense(self, term: Term, arm: Arm, wrench: Array, motion: Motion) -> Array:
        """Add the mass's weight and inertia to what the flange sensor carries."""
        assert motion.pieces is not None
        return wrench + term.values[0] * motion.pieces.payload_wrench

    def drive(self, term: Term, arm: Arm, torque: Array, motion: Motion) -> Array:
        """Add what holds and moves the mass."""
        assert motion.pieces is not None
        return torque + term.values[0] * motion.pieces.payload_torque
