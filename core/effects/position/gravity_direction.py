"""A base that does not stand level."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import Effect, Parameter, Term

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.kernels.rates import ChainRate
    from gapbridge.core.kernels.reference import Chain


class GravityDirection(Effect):
    """Gravity points elsewhere in base than the cell says: the base does not stand level.

    Two rotations of the gravity vector about x and y of base. Shows only through something that
    bends: a rigid model's positions do not depend on gravity.
    """

    identifier = "gravity_direction"
    title = "base is not level"
    label_template = "tilt of the base about {part}"
    acts_through_deflection = True
    channels = ("position",)
    motion = "a compliant model and poses all around the base"
    simulator_advice = "turn the base, or gravity in the world"
    fixed_parameters = (  # the rotation vector's x and y, base axes
        Parameter("x", "rad", 0.02, -0.5, 0.5),
        Parameter("y", "rad", 0.02, -0.5, 0.5),
    )

    def shape(self, term: Term, arm: Arm, chain: Chain) -> None:
        """Turn gravity."""
        import numpy as np

        from gapbridge.core.rotation import rotation_matrix

        turn = rotation_matrix(np.array([term.values[0], term.values[1], 0.0]))
        chain.gravity[:] = turn @ chain.gravity

    def shape_rate(self, term: Term, arm: Arm, chain: Chain, value: int, rate: ChainRate) -> bool:
        """Write how gravity turns."""
        import numpy as np

        from gapbridge.core.rotation import left_jacobian

        turn = left_jacobian(np.array([term.values[0], term.values[1], 0.0]))[:, value]
        rate.gravity[:] = np.cross(turn, chain.gravity)
        return True
