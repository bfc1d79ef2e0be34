"""A payload whose centre of gravity is elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.effect import Effect, Parameter, Site, Term
from gapbridge.core.effects.simulator import Kind, SimulatorChange, along_axes

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.kernels.reference import Rows
    from gapbridge.core.loads import Loads
    from gapbridge.core.motion import Motion


class PayloadCog(Effect):
    """The load's centre of gravity is elsewhere: true centre = declared + shift, flange axes.

    Comes from a drawing of the gripper without its hoses, or a part that is held off centre. Shows
    as moment at the flange sensor, as joint torque and as bending; needs a payload, and poses that
    turn the flange against gravity. Under one constant load the last link's ``link_cog`` is the
    same; a second payload separates them. Poses that never turn the flange against gravity do not
    separate it from the sensor's zero. A shift along gravity alone shows nothing.
    Source: Hollerbach, Khalil, Gautier, "Model Identification", Springer Handbook of Robotics
    (2016), ch. 6.
    """

    identifier = "payload_cog"
    title = "load's centre of gravity is elsewhere"
    label_template = "centre of gravity {part}"
    order = 12
    acts_through_deflection = True
    loads_joints = True
    identifiable_with = Term("payload", Site(), (1.0,))  # values are then first moments, of 1 kg
    replaces_cell_value = "payload"
    equal_of_last_link = "link_cog"
    channels = ("position", "wrench", "torque")
    motion = "a payload, and poses that turn the flange against gravity"
    equivalents: ClassVar = {
        "link_cog": "one constant load: the last link's first moment is the load's mass times it",
        "ft_bias": "one load, and a flange that never turns against gravity",
    }
    simulator_advice = "move the centre of mass of the body that models the load"
    fixed_parameters = tuple(Parameter(k, "m", 0.02, -1.0, 1.0) for k in "xyz")  # flange axes

    def simulator(self, term: Term, arm: Arm) -> tuple[SimulatorChange, ...]:
        """Return it in a simulator's terms."""
        return along_axes(Kind.PAYLOAD_COG, None, term.values)

    def condition(self, term: Term, arm: Arm, rows: Rows, loads: Loads, q: Array) -> None:
        """Move the centre of gravity."""
        rows.payload_cog[:] += term.values

    def sense(self, term: Term, arm: Arm, wrench: Array, motion: Motion) -> Array:
        """Add what the load does more to the sensor from there."""
        import numpy as np

        assert motion.pieces is not None
        _, moved = motion.pieces.payload_from(np.array(term.values))
        there = moved - motion.pieces.payload_wrench
        return wrench + motion.pieces.carried_mass[:, None] * there

    def drive(self, term: Term, arm: Arm, torque: Array, motion: Motion) -> Array:
        """Add what holds and moves the load more from there."""
        import numpy as np

        assert motion.pieces is not None
        moved, _ = motion.pieces.payload_from(np.array(term.values))
        there = moved - motion.pieces.payload_torque
        return torque + motion.pieces.carried_mass[:, None] * there
