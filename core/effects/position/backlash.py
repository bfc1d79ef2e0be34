"""Play in the gears."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import JointEffect, Parameter, Term
from gapbridge.core.effects.simulator import Kind

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.kernels.reference import Rows
    from gapbridge.core.loads import Loads


class Backlash(JointEffect):
    """The joint has play, taken up against its last motion: - half the clearance times approach.

    Comes from worn gears and belts. Needs poses that are reached from both sides; without reversals
    nothing can be said.
    Source: He et al. 2024 on joint hysteresis (SMART5 NJ220).
    """

    identifier = "backlash"
    title = "play in the joint"
    label_template = "play of joint {joint}"
    adds_up = True
    depends_on_approach = True
    channels = ("position",)
    simulated_as = Kind.PLAY
    motion = "poses reached from both sides of the joint"
    simulator_advice = "add a joint about the same axis, limited to half the clearance on each side"
    fixed_parameters = (Parameter("", "rad", 3e-4, 0.0, 0.1),)  # the whole clearance

    def condition(self, term: Term, arm: Arm, rows: Rows, loads: Loads, q: Array) -> None:
        """Turn the joint back by half the clearance."""
        if loads.approach is not None:
            i = term.site.index
            rows.q[:, i] -= 0.5 * term.values[0] * loads.approach[:, i]
