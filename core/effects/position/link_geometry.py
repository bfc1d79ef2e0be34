"""Lengths and twists of links."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

from gapbridge.core.effects.effect import Effect, Parameter, Site, Term

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.kernels.rates import ChainRate
    from gapbridge.core.kernels.reference import Chain

# Sines of the angle below which two axes count as parallel. Factory calibrations and rounded angles
# leave 1e-6 to a few 1e-3 where the drawing has parallel axes, whose common normal is then up to
# hundreds of metres away; drawings have 0 or far more
PARALLEL = 1e-2
EXACTLY_PARALLEL = 1e-6  # the same of terms without beta


class LinkForm(NamedTuple):
    """A link from its joint's axis z to the next one's, as Tz(d) Tx(a) Rx(alpha) Tz(shift)."""

    z: Array
    x: Array  # the common normal
    next_z: Array
    y: Array  # across both
    shift: float  # m, how far the next frame lies along its own axis from the common normal
    parallel: bool


def link_form(arm: Arm, joint: int, least: float = PARALLEL) -> LinkForm:
    """Return the common normal of link ``joint`` (from 1), in the frame of that link.

    Axes count as parallel if the sine of their angle is below ``least``.
    """
    return _form(arm.link_in_link[joint].tobytes(), least)


def _form_of(term: Term, arm: Arm) -> LinkForm:
    """Return the form that a term's values are of.

    Terms of nearly parallel axes without beta are of the far common normal, as older cells hold.
    """
    assert term.site.joint is not None
    least = PARALLEL if len(term.values) > 3 else EXACTLY_PARALLEL
    return link_form(arm, term.site.joint, least)


@lru_cache(maxsize=256)  # a fit asks for the few links of one arm thousands of times
def _form(link: bytes, least: float) -> LinkForm:
    """Return the form of a link from the bytes of its transform (4, 4)."""
    import numpy as np

    step = np.frombuffer(link).reshape(4, 4)
    z, next_z, p = np.array([0, 0, 1.0]), step[:3, 2], step[:3, 3]
    sine = float(np.hypot(next_z[0], next_z[1]))
    if sine < least:
        across = np.array([p[0], p[1], 0.0])
        length = float(np.linalg.norm(across))
        # standard DH rows have x along the frame's own x, whatever the sign of a
        along_x = length < 1e-9 or abs(p[1]) < 1e-9
        x = np.array([1.0, 0, 0]) if along_x else across / length
        if sine >= EXACTLY_PARALLEL and x[0] < 0:  # the origin is not quite on the row's x
            x = -x
        return LinkForm(z, x, next_z, np.cross(next_z, x), 0.0, True)
    x = np.cross(z, next_z) / sine
    if abs(next_z[0]) < 1e-9:
        x = np.array([1.0, 0, 0])
    _, _, shift = np.linalg.solve(np.column_stack([z, x, next_z]), p)
    return LinkForm(z, x, next_z, np.cross(next_z, x), float(shift), False)


class LinkGeometry(Effect):
    """A link is longer, offset or twisted otherwise than its drawing: a, d, alpha of a link.

    Comes from machining and assembly; for UR arms it is what the factory calibration holds. Between
    parallel axes d of one link cannot be distinguished from d of the next, and a small twist beta
    about y is
    added (Hayati), because alpha alone cannot describe a slight misalignment there. The last link
    is part of the tool frame. The joint's zero is ``joint_offset``.
    Source: Hayati, Mirmirani, J. Robotic Systems 2 (1985) 397; standard DH rows.
    """

    identifier = "link_geometry"
    estimated_as_whole = True
    title = "link measures differ"
    label_template = "{part} of link {joint}"
    calibration_rank = 3
    channels = ("position",)
    motion = "poses that differ in the joint before the link"

    def sites(self, arm: Arm) -> tuple[Site, ...]:
        """Return the links between two joints."""
        return tuple(Site(joint=i + 1) for i in range(arm.n - 1))

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return a, d, alpha, and beta between parallel axes."""
        assert site.joint is not None
        own = (
            Parameter("a", "m", 1e-3, -0.1, 0.1),
            Parameter("d", "m", 1e-3, -0.1, 0.1),
            Parameter("alpha", "rad", 1e-3, -0.1, 0.1),
        )
        if not link_form(arm, site.joint).parallel:
            return own
        nearly = not link_form(arm, site.joint, EXACTLY_PARALLEL).parallel
        return (*own, Parameter("beta", "rad", 1e-3, -0.1, 0.1, optional=nearly))

    def shape(self, term: Term, arm: Arm, chain: Chain) -> None:
        """Move and twist the next joint's frame."""
        from gapbridge.core.rotation import one_rotation_matrix

        joint = term.site.joint
        assert joint is not None
        form = _form_of(term, arm)
        a, d, alpha = term.values[:3]
        twist = one_rotation_matrix(form.x * alpha)
        turned = twist @ chain.rotation[joint]
        if form.parallel and len(term.values) > 3:
            turned = one_rotation_matrix(twist @ form.y * term.values[3]) @ turned
        chain.rotation[joint] = turned
        moved = form.shift * (twist @ form.next_z - form.next_z)
        chain.position[joint] += d * form.z + a * form.x + moved

    def shape_rate(self, term: Term, arm: Arm, chain: Chain, value: int, rate: ChainRate) -> bool:
        """Write the way along z or the common normal, or the turn about it or across."""
        import numpy as np

        from gapbridge.core.rotation import one_rotation_matrix

        assert term.site.joint is not None
        form, link = _form_of(term, arm), rate.link[term.site.joint]
        if value == 0:
            link[:3] = form.x
        elif value == 1:
            link[:3] = form.z
        else:
            twist = one_rotation_matrix(form.x * term.values[2])
            if value == 2:  # beta turns about an axis that alpha has turned: so both turn at once
                link[3:] = form.x
                link[:3] = form.shift * np.cross(form.x, twist @ form.next_z)
            else:
                link[3:] = twist @ form.y
        return True
