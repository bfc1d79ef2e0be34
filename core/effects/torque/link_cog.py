"""Links whose centre of gravity is elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from gapbridge.core.effects.effect import JointEffect, Parameter, Site, Term, typical_moment
from gapbridge.core.effects.simulator import Kind, SimulatorChange, along_axes

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


class LinkCog(JointEffect):
    """A link's centre of gravity is elsewhere: its first moment, mass times the shift.

    Axes of the URDF link (with ``dh`` those of the row's frame). Comes from cables, covers, and
    drawings without motors. Shows in the weight that the joint and those before it hold; the mass
    stays, which ``link_inertia`` changes. The link's inertia about its joint grows with the shift
    up to 0.15 m: more than that is a counterweight's, not the link's own mass. Part of the moment
    loads no joint, or cannot be distinguished from the next link's: only some combinations are
    found, the rest stays open. Under one constant load the last link's is the same as
    ``payload_cog``.
    Source: Gautier, Khalil, IEEE Trans. Robotics and Automation 6 (1990) 368, on base parameters.
    """

    identifier = "link_cog"
    title = "link's centre of gravity is elsewhere"
    label_template = "first moment {part} of link {joint}"
    order = 22
    loads_joints = True
    adds_torque = True
    estimated_as_whole = True
    channels = ("torque",)
    motion = "poses that turn the link against gravity, or its accelerations"
    equivalents: ClassVar = {"link_inertia": "poses at which the link pulls in one direction"}
    simulator_advice = "move the link's centre of mass by the first moment over its mass"

    def sites(self, arm: Arm) -> tuple[Site, ...]:
        """Return the links that have a mass."""
        return tuple(Site(joint=i + 1) for i in range(arm.n) if arm.mass[i] > 0)

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the first moment in the link's axes."""
        scale = 1e-3 * typical_moment(arm)  # some centimetres of a link of some kg
        return tuple(Parameter(k, "kg m", scale, -1e3 * scale, 1e3 * scale) for k in "xyz")

    def simulator(self, term: Term, arm: Arm) -> tuple[SimulatorChange, ...]:
        """Return it in a simulator's terms."""
        import numpy as np

        assert term.site.joint is not None
        i, moment = term.site.index, np.array(term.values)
        in_joint = moment if arm.body_axes is None else arm.body_axes[i] @ moment
        return along_axes(Kind.LINK_MOMENT, term.site.joint, in_joint)

    def drive(self, term: Term, arm: Arm, torque: Array, motion: Motion) -> Array:
        """Add what holds and moves the first moment."""
        import numpy as np

        assert motion.pieces is not None
        i, moment = term.site.index, np.array(term.values)
        in_link = moment if arm.body_axes is None else arm.body_axes[i] @ moment
        return torque + motion.pieces.link_from(i, in_link)
