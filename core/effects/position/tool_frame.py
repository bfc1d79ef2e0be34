"""Where the tool centre point sits in the flange."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import Effect, Parameter, Term

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.kernels.rates import ChainRate
    from gapbridge.core.kernels.reference import Chain


class ToolFrame(Effect):
    """The TCP sits elsewhere in the flange than the cell file says (flange axes).

    Comes from a bent or changed tool, or a TCP taught by hand. Its rotation shows only where the
    instrument measures rotations too. A zero offset of the last joint is a part of it.
    """

    identifier = "tool_frame"
    title = "tool (TCP) sits elsewhere"
    label_template = "tool {part}"
    calibration_rank = 1
    replaces_cell_value = "tool"
    verification_message = "the tool moved by {size}: run the short session for the tool"
    estimated_with_links = True
    channels = ("position",)
    motion = "poses that differ in the orientation of the flange"
    fixed_parameters = (  # shift and rotation vector, flange axes
        *(Parameter(k, "m", 1e-3, -0.5, 0.5) for k in "xyz"),
        *(Parameter(k, "rad", 3e-3, -0.5, 0.5, of_rotation=True) for k in ("rx", "ry", "rz")),
    )

    def shape(self, term: Term, arm: Arm, chain: Chain) -> None:
        """Move the TCP."""
        import numpy as np

        from gapbridge.core.rotation import one_rotation_matrix

        chain.tool_position[:] += term.values[:3]
        turn = one_rotation_matrix(np.array(term.values[3:]))
        chain.tool_rotation[:] = turn @ chain.tool_rotation

    def shape_rate(self, term: Term, arm: Arm, chain: Chain, value: int, rate: ChainRate) -> bool:
        """Write the shift, or the turn."""
        import numpy as np

        from gapbridge.core.rotation import left_jacobian

        if value < 3:
            rate.tool[value] = 1.0
        else:
            rate.tool[3:] = left_jacobian(np.array(term.values[3:]))[:, value - 3]
        return True
