"""A measuring target that moves on the tool."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.effect import Effect, Parameter, Term, rows_after

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.kernels.reference import Chain
    from gapbridge.core.loads import Loads


class TargetSlip(Effect):
    """The target on the tool moves once, at one moment of the log, by a shift in flange axes.

    Comes from a reflector or probe that was knocked, changed or put back. Rows after ``time`` (s of
    ``timestamp``, or the number of the row where the log has none) have the tool centre point
    there; live setpoints always do. The moment is found by likelihood over all rows, so it lies
    between two of them. A joint that slips turns with the joints before it, a target with the
    flange: poses that differ in the last joints separate them. A shift that was there all the
    time is ``tool_frame``.
    Source: Page, Biometrika 41 (1954) 100; Hinkley, Biometrika 57 (1970) 1, on change points.
    """

    identifier = "target_slip"
    title = "target has slipped on the tool"
    label_template = "slip of the target {part}"
    at_moment = True
    channels = ("position",)
    motion = "poses before and after the moment, that differ in the orientation of the flange"
    equivalents: ClassVar = {
        "tool_frame": "no pose before the moment",
        "joint_slip": "no joint beyond the slipped one moves after the moment",
    }
    of_the_arm = False
    simulator_advice = "none needed: a simulated target does not move"
    fixed_parameters = (  # flange axes
        *(Parameter(k, "m", 1e-3, -0.5, 0.5) for k in "xyz"),
        Parameter("time", "s", 1.0),
    )

    def shape(self, term: Term, arm: Arm, chain: Chain) -> None:
        """Move the TCP."""
        chain.tool_position[:] += term.values[:3]

    def before(
        self,
        term: Term,
        chain: Chain,
        position: Array,
        rotation: Array,
        loads: Loads,
    ) -> None:
        """Put the TCP back in the rows before the slip."""
        import numpy as np

        if loads.time is None:
            return
        rows = ~rows_after(term, loads)
        position[rows] -= rotation[rows] @ (chain.tool_rotation.T @ np.array(term.values[:3]))
