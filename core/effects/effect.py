"""The base of the catalogue: what an effect is, and how it enters a model.

An effect is one physical cause of a sim-to-real gap. A *term* is one occurrence of it: an effect at
one joint (or at none) with its parameter values. Every prediction of a model (position, wrench,
tracking, torque) passes through the hooks of the terms it holds, so that one and the same code
serves fitting, diagnosis, prediction and live compensation. A member overrides the hooks of the
channels in which it shows; derivatives are taken by the diagnosis, numerically, of the whole
prediction.
"""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from core.arm import Arm
    from core.kernel import Chain, Rows
    from core.kernels.rates import ChainRate
    from core.loads import Loads
    from core.motion import Motion

Array = NDArray[np.float64]
CHANNELS = {"position": "m", "wrench": "N", "tracking": "rad", "torque": "Nm"}


@dataclass(frozen=True)
class Parameter:
    """One number of an effect: what the real arm has more than the model."""

    name: str  # one word, '' where the effect's own name says it
    unit: str
    scale: float  # a usual size, for steps, priors and scaling
    lower: float = -np.inf
    upper: float = np.inf


@dataclass(frozen=True)
class Site:
    """Where an effect can sit: a joint (from 1) or the whole arm (None), and a period if it has."""

    joint: int | None = None
    order: float | None = None  # cycles per turn of the joint


@dataclass(frozen=True)
class Term:
    """One effect at one site with values for its parameters, in the order the effect names them."""

    effect: str
    site: Site
    values: tuple[float, ...]
    stand_in: bool = field(default=False, compare=False)  # True: useful, but not proved

    def with_values(self, values: Array) -> Term:
        """Return the same term with other values."""
        return replace(self, values=tuple(float(v) for v in values))


@dataclass(frozen=True)
class Reported:
    """A parameter as it is told: in the unit and form of CONTRACT's signs."""

    name: str
    value: float
    std: float | None
    unit: str


class Effect(ABC):
    """One member of the catalogue; its docstring is what ``gapbridge explain`` prints."""

    identifier: ClassVar[str]
    channels: ClassVar[tuple[str, ...]]
    needs: ClassVar[tuple[str, ...]] = ()  # log columns beyond those of its channel
    motion: ClassVar[str] = ""  # what a log must contain so that the effect shows

    def sites(self, arm: Arm) -> tuple[Site, ...]:
        """Return where the effect can sit on this arm."""
        return (Site(),)

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the parameters of one occurrence."""
        raise NotImplementedError

    def shape(self, term: Term, arm: Arm, chain: Chain) -> None:
        """Change the chain in place: what holds for all rows (position channel)."""

    def shape_rate(self, term: Term, arm: Arm, chain: Chain, value: int, rate: ChainRate) -> bool:
        """Write how the finished chain changes with one of the term's values, into zeros.

        Returns whether that is known; where not, derivatives are differences of predictions.
        """
        return False

    def condition(self, term: Term, arm: Arm, rows: Rows, loads: Loads, q: Array) -> None:
        """Change the rows in place; ``q`` (N, n) are the encoder angles (position channel)."""

    def sense(self, term: Term, arm: Arm, wrench: Array, motion: Motion) -> Array:
        """Return what the flange sensor would read instead of ``wrench`` (N, 6)."""
        return wrench

    def track(self, term: Term, arm: Arm, q: Array, motion: Motion) -> Array:
        """Return where the encoders would stand instead of ``q`` (N, n)."""
        return q

    def drive(self, term: Term, arm: Arm, torque: Array, motion: Motion) -> Array:
        """Return the joint torques that would be measured instead of ``torque`` (N, n)."""
        return torque

    def reported(self, arm: Arm, term: Term, covariance: Array | None) -> tuple[Reported, ...]:
        """Return the term's parameters as they are told; ``covariance`` is (k, k) or None."""
        told = []
        for k, parameter in enumerate(self.parameters(arm, term.site)):
            std = None
            if covariance is not None and k < len(covariance):  # the rest was not fitted
                std = float(np.sqrt(max(covariance[k, k], 0.0)))
            told.append(
                Reported(self.label(term.site, parameter), term.values[k], std, parameter.unit)
            )
        return tuple(told)

    def label(self, site: Site, parameter: Parameter) -> str:
        """Return the public name of a parameter: ``axial_compliance_2``, ``link_geometry_3_a``."""
        parts = [self.identifier, site.joint, parameter.name]
        return "_".join(str(p) for p in parts if p not in (None, ""))


class JointEffect(Effect):
    """An effect that every joint can have alone."""

    def sites(self, arm: Arm) -> tuple[Site, ...]:
        """Return one site a joint."""
        return tuple(Site(joint=i + 1) for i in range(arm.n))


def typical_moment(arm: Arm) -> float:
    """Return a usual joint moment (Nm): the arm's weight at half its stretched length.

    Only scales parameters, so that solvers see numbers near one.
    """
    reach = float(np.linalg.norm(arm.link_in_link[:, :3, 3], axis=1).sum())
    payload = arm.payload if np.isfinite(arm.payload) else 5.0
    return max(9.81 * (float(arm.mass.sum()) / 3 + payload) * max(reach, 0.1) / 2, 1.0)
