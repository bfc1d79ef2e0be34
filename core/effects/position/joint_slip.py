"""Joints whose zero steps."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.effect import JointEffect, Parameter, Term, rows_after
from gapbridge.core.effects.simulator import Kind

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.kernels.reference import Rows
    from gapbridge.core.loads import Loads


class JointSlip(JointEffect):
    """The zero of one joint steps once, at one moment of the log: true angle = actual_q + step.

    From that moment on; before it the zero is the model's. Comes from a collision, a belt that
    jumps a tooth, an encoder or a coupling that slips on its shaft. Rows after ``time`` (s of
    ``timestamp``, or the number of the row where the log has none) take the step; live setpoints
    always do. The moment is found by likelihood over all rows, so it lies between two of them. An
    offset that was there all the time is ``joint_offset``; needs poses before and after.
    Source: Page, Biometrika 41 (1954) 100; Hinkley, Biometrika 57 (1970) 1, on change points.
    """

    identifier = "joint_slip"
    title = "joint zero has slipped"
    label_template = "slip of joint {joint} {part}"
    at_moment = True
    channels = ("position",)
    simulated_as = Kind.JOINT_ZERO  # the arm as it is since
    motion = "poses before and after the moment, that differ in the other joints"
    equivalents: ClassVar = {"joint_offset": "no pose before the moment"}
    fixed_parameters = (Parameter("", "rad", 1e-3, -1.0, 1.0), Parameter("time", "s", 1.0))

    def condition(self, term: Term, arm: Arm, rows: Rows, loads: Loads, q: Array) -> None:
        """Turn the joint further in the rows after the slip."""
        rows.q[rows_after(term, loads), term.site.index] += term.values[0]
