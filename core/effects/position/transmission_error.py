"""Periodic errors of gears and encoders."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import JointEffect, Parameter, Reported, Site, Term

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.kernels.reference import Rows
    from gapbridge.core.loads import Loads


class TransmissionError(JointEffect):
    """The joint runs ahead and behind in a periodic way: + amplitude sin(order q + phase).

    Comes from eccentric encoder discs (one and two cycles a turn) and from gears (many cycles a
    turn: strain-wave generators two per input turn, so twice the ratio and its fractions). At most
    a few lines per joint, each found significant alone; a shape that sits in one place only is no
    period.
    Source: Hu et al. 2020 on joint modules (harmonic angle error); Tuttle, Seering, IEEE Trans.
    Robotics and Automation 12 (1996) 368 on harmonic drives.
    """

    identifier = "transmission_error"
    title = "periodic gear error"
    label_template = "gear error of joint {joint} ({part})"
    periodic = True
    channels = ("position",)
    motion = "many different angles of the joint"
    simulator_advice = (
        "add amplitude sin(order q + phase) to the commanded angle in the control loop"
    )
    fixed_parameters = (  # coefficients of sine and cosine, in which the effect is linear
        Parameter("sine", "rad", 3e-4, -0.1, 0.1),
        Parameter("cosine", "rad", 3e-4, -0.1, 0.1),
    )

    def angle_columns(self, site: Site, q: Array) -> Array:
        """Return sine and cosine of the angle times the order."""
        import numpy as np

        assert site.order is not None
        return np.stack([np.sin(site.order * q), np.cos(site.order * q)], axis=-1)

    def condition(self, term: Term, arm: Arm, rows: Rows, loads: Loads, q: Array) -> None:
        """Turn the joint by the wave at its encoder angle."""
        assert term.site.joint is not None and term.site.order is not None
        i = term.site.index
        rows.q[:, i] += self.angle_columns(term.site, q[:, i]) @ term.values

    def reported(self, arm: Arm, term: Term, covariance: Array | None) -> tuple[Reported, ...]:
        """Return order, amplitude and phase of amplitude sin(order q + phase)."""
        import numpy as np

        sine, cosine = term.values
        amplitude = float(np.hypot(sine, cosine))
        spread: list[float | None] = [None, None]
        if covariance is not None and amplitude > 0:
            radial = np.array([sine, cosine]) / amplitude
            across = np.array([-cosine, sine]) / amplitude**2
            spread = [float(np.sqrt(g @ covariance @ g)) for g in (radial, across)]
        order = float(term.site.order or 0)
        name = f"{self.identifier}_{term.site.joint}_order{order:g}"
        return (
            Reported(f"{name}_amplitude", amplitude, spread[0], "rad", "amplitude"),
            Reported(f"{name}_phase", float(np.arctan2(cosine, sine)), spread[1], "rad", "phase"),
        )
