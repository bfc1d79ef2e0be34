"""Dry friction of joints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gapbridge.core.effects.effect import JointEffect, Parameter, Site, Term, typical_moment
from gapbridge.core.effects.simulator import Kind, SimulatorChange

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gapbridge.core.arm import Arm
    from gapbridge.core.motion import Motion


class CoulombFriction(JointEffect):
    """The motor delivers a constant torque more, along the motion: + F sign(qd).

    Comes from seals, bearings, gear mesh. At rest the friction may be anything up to F, so rows in
    which the direction is unsure count smoothly: F tanh(4 qd / band), with the band from the noise
    and the speed of the log. Needs motion both ways: one way only it looks like a constant torque.
    Several speeds separate it from viscous friction.
    Source: Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994) 1083.
    """

    identifier = "coulomb_friction"
    title = "constant friction"
    order = 52
    channels = ("torque",)
    motion = "the joint moved both ways"

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the torque."""
        return (Parameter("", "Nm", 0.03 * joint_scale(arm, site), 0.0, np.inf),)

    def simulator(self, term: Term, arm: Arm) -> tuple[SimulatorChange, ...]:
        """Return it in a simulator's terms."""
        return (SimulatorChange(Kind.FRICTION, term.site.joint, term.values[0]),)

    def drive(
        self, term: Term, arm: Arm, torque: NDArray[np.float64], motion: Motion
    ) -> NDArray[np.float64]:
        """Add the friction that the motor overcomes."""
        assert term.site.joint is not None
        i = term.site.joint - 1
        result = torque.copy()
        result[:, i] += term.values[0] * motion.direction[:, i]
        return result


def joint_scale(arm: Arm, site: Site) -> float:
    """Return a usual torque (Nm) of a joint: its rated effort, or what the arm's weight makes."""
    assert site.joint is not None
    effort = float(arm.limits.effort[site.joint - 1])
    return effort if np.isfinite(effort) and effort > 0 else typical_moment(arm)
