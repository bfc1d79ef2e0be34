"""The base of the catalogue: what an effect is, and how it enters a model.

An effect is one physical cause of a sim-to-real gap. A *term* is one occurrence of it: an effect at
one joint (or at none) with its parameter values. Every prediction of a model (position, wrench,
tracking, torque) passes through the hooks of the terms it holds, so that one and the same code
serves fitting, diagnosis, prediction and live compensation. A member overrides the hooks of the
channels in which it shows; derivatives are taken by the diagnosis, numerically, of the whole
prediction.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

from gapbridge.core.effects.simulator import Kind, SimulatorChange

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.kernels.rates import ChainRate
    from gapbridge.core.kernels.reference import Chain, Rows
    from gapbridge.core.loads import Loads
    from gapbridge.core.motion import Motion

CHANNELS = {"position": "m", "wrench": "N", "tracking": "rad", "torque": "Nm"}
WRENCH_AXES = ("fx", "fy", "fz", "mx", "my", "mz")


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect, real minus model."""

    name: str  # one word, '' if the effect's name suffices
    unit: str
    scale: float  # a usual size, for steps, priors and scaling
    lower: float = -math.inf
    upper: float = math.inf
    of_rotation: bool = False  # True: shows only where the instrument measures rotations too
    optional: bool = False  # True: a term may end before it, as in cells that are older than it


@dataclass(frozen=True)
class Site:
    """Where an effect acts: a joint (from 1) or the whole arm (None), and the order of a period."""

    joint: int | None = None
    order: float | None = None  # cycles per turn of the joint

    @property
    def index(self) -> int:
        """Return the joint's index in arrays, from 0."""
        assert self.joint is not None
        return self.joint - 1


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
    """A parameter as it is reported: in the unit and sign of docs/conventions.md."""

    name: str
    value: float
    std: float | None
    unit: str
    part: str = ""  # which of its effect's numbers it is, as in the name's end
    is_time: bool = False  # True: a moment on the clock of the log
    session: str = ""  # the first session after a moment, where the sessions' clocks overlap


@dataclass(frozen=True)
class ParameterName:
    """The public name of a parameter, of an effect, or of an effect at one joint, in its parts."""

    effect: str
    joint: int | None  # from 1
    order: float | None  # cycles per turn of the joint
    part: str


class Effect(ABC):
    """One member of the catalogue; its docstring is what ``gapbridge explain`` prints.

    Code that depends on an effect reads its attributes, never its name.
    """

    identifier: ClassVar[str]
    channels: ClassVar[tuple[str, ...]]
    needs: ClassVar[tuple[str, ...]] = ()  # log columns beyond those of its channel
    motion: ClassVar[str] = ""  # what a log must contain for the effect to be identifiable
    equivalents: ClassVar[Mapping[str, str]] = {}  # effect: on which data it is the same
    simulator_advice: ClassVar[str] = ""  # the advice if a simulator's model cannot include it
    simulated_as: ClassVar[Kind | None] = None  # the kind of its first value in a simulator's model
    fixed_parameters: ClassVar[tuple[Parameter, ...]]  # of every occurrence, on any arm
    of_the_arm: ClassVar[bool] = True  # False: an effect of the measurement, not of the arm

    # texts
    title: ClassVar[str] = ""  # in plain words; default: the identifier without underscores
    label_template: ClassVar[str] = ""  # of one parameter, with {joint} and {part}
    verification_message: ClassVar[str] = ""  # of a verification that detects it; '': not checked

    # how it acts
    order: ClassVar[int] = 50  # order of application from load to reading, in its channel
    periodic: ClassVar[bool] = False  # True: sites have an order, and values are sine and cosine
    is_delay: ClassVar[bool] = False  # True: its only value is a delay of the joint, s
    at_moment: ClassVar[bool] = False  # True: a step at one time, the last value
    depends_on_approach: ClassVar[bool] = False  # True: on the joint's last motion
    softens: ClassVar[bool] = False  # True: a flexibility, 0 or more together with the model's
    flexibility: ClassVar[str] = ""  # which of a joint's linear flexibilities: axial, radial
    acts_through_deflection: ClassVar[bool] = False  # True: not visible on a rigid arm
    loads_joints: ClassVar[bool] = False  # True: a load on the joints, on which friction may depend
    adds_torque: ClassVar[bool] = False  # True: to that of the other terms, whatever it is
    depends_on_load: ClassVar[bool] = False  # True: ``added`` depends on the load of the joint
    adds_mass: ClassVar[bool] = False  # True: kg in addition to the declared payload
    # True: 0 or more, and two terms of one site are the same as one with the sum of their values
    adds_up: ClassVar[bool] = False
    scales_reading: ClassVar[bool] = False  # True: does not change a reading of zero
    fits_any_constant: ClassVar[bool] = False  # True: can represent any constant reading
    estimated_as_whole: ClassVar[bool] = False  # True: small at all sites of a real arm
    # True: estimated with the links: joint zeros and TCP with geometry, friction with masses
    estimated_with_links: ClassVar[bool] = False
    identifiable_with: ClassVar[Term | None] = None  # the term that it needs beside it

    # how it is estimated
    start_values: ClassVar[tuple[float, ...]] = ()  # start values of its last parameter
    has_nonlinearity: ClassVar[bool] = False  # True: first value a slope, second a nonlinearity
    replaces: ClassVar[str] = ""  # the effect of the same joint that it replaces
    equal_of_last_link: ClassVar[str] = ""  # the last link's effect that equals it under one load
    equals_sum_of: ClassVar[str] = ""  # the effect whose parameters in sum equal it
    calibration_rank: ClassVar[int] = 0  # among a calibration's default effects; 0: none
    replaces_cell_value: ClassVar[str] = ""  # the value of the cell that a session measures instead

    @property
    def calibratable(self) -> bool:
        """Return whether a calibration can estimate it: from measured positions, at any time."""
        return "position" in self.channels and not self.at_moment

    def sites(self, arm: Arm) -> tuple[Site, ...]:
        """Return where the effect can sit on this arm."""
        return (Site(),)

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the parameters of one occurrence; default: ``fixed_parameters``."""
        return self.fixed_parameters

    def angle_columns(self, site: Site, q: Array) -> Array | None:
        """Return d joint angle / d parameter (N, d) at encoder angles ``q`` (N,) of its joint.

        For effects that turn the joint by its own angle alone; None for all others.
        """
        return None

    def shape(self, term: Term, arm: Arm, chain: Chain) -> None:
        """Change the chain in place: what holds for all rows (position channel)."""

    def shape_rate(self, term: Term, arm: Arm, chain: Chain, value: int, rate: ChainRate) -> bool:
        """Write d chain / d one of the term's values into ``rate``, which holds zeros.

        Returns False where it is not implemented: the derivatives are then numerical.
        """
        return False

    def condition(self, term: Term, arm: Arm, rows: Rows, loads: Loads, q: Array) -> None:
        """Change the rows in place; ``q`` (N, n) are the encoder angles (position channel)."""

    def before(
        self, term: Term, chain: Chain, position: Array, rotation: Array, loads: Loads
    ) -> None:
        """Undo the effect in predicted TCP poses (N, 3), (N, 3, 3) of rows before its time.

        For effects whose ``shape`` holds from a time on.
        """

    def sense(self, term: Term, arm: Arm, wrench: Array, motion: Motion) -> Array:
        """Return what the flange sensor would read instead of ``wrench`` (N, 6)."""
        return wrench

    def track(self, term: Term, arm: Arm, q: Array, motion: Motion) -> Array:
        """Return the encoder angles (N, n), rad, with this effect, for those without it ``q``."""
        assert motion.held is not None
        return self.settle(term, arm, q, motion.held, motion.loads.approach)

    def settle(self, term: Term, arm: Arm, q: Array, held: Array, approach: Array | None) -> Array:
        """Return the encoder angles at rest (N, n), rad, for commands ``q`` (N, n), rad.

        ``held`` (N, n) is the motor torque of each joint at rest, Nm, positive towards positive q;
        ``approach`` (N, n) the sign of its last motion. The difference from ``q`` is compensated in
        live setpoints.
        """
        return q

    def drive(self, term: Term, arm: Arm, torque: Array, motion: Motion) -> Array:
        """Return the joint torques that would be measured instead of ``torque`` (N, n)."""
        return torque

    def simulator(self, term: Term, arm: Arm) -> tuple[SimulatorChange, ...]:
        """Return the changes of a simulator's model, in addition to those of ``shape``."""
        if self.simulated_as is None:
            return ()
        return (SimulatorChange(self.simulated_as, term.site.joint, term.values[0]),)

    def reported(self, arm: Arm, term: Term, covariance: Array | None) -> tuple[Reported, ...]:
        """Return the term's parameters as they are reported; ``covariance`` is (k, k) or None."""
        lines = []
        for k, parameter in enumerate(self.parameters(arm, term.site)[: len(term.values)]):
            std = None
            if covariance is not None and k < len(covariance):  # the rest was not fitted
                std = math.sqrt(max(covariance[k, k], 0.0)) or None
            is_time = self.at_moment and k == len(term.values) - 1
            lines.append(
                Reported(self.label(term.site, parameter), term.values[k], std, parameter.unit,
                         parameter.name, is_time)
            )  # fmt: skip
        return tuple(lines)

    def label(self, site: Site, parameter: Parameter) -> str:
        """Return the public name of a parameter: ``axial_compliance_2``, ``link_geometry_3_a``."""
        parts = [self.identifier, site.joint, parameter.name]
        return "_".join(str(p) for p in parts if p not in (None, ""))


class JointEffect(Effect):
    """An effect that every joint can have alone."""

    def sites(self, arm: Arm) -> tuple[Site, ...]:
        """Return one site a joint."""
        return tuple(Site(joint=i + 1) for i in range(arm.n))


class TorqueEffect(JointEffect):
    """What a joint's motor delivers more."""

    channels = ("torque",)
    adds_torque = True

    def drive(self, term: Term, arm: Arm, torque: Array, motion: Motion) -> Array:
        """Add it at the joint."""
        result = torque.copy()
        result[:, term.site.index] += self.added(term, term.site.index, motion)
        return result

    @abstractmethod
    def added(self, term: Term, i: int, motion: Motion) -> Array:
        """Return the torque (N,), Nm, that the motor of joint ``i`` (from 0) delivers more."""


class ServoEffect(JointEffect):
    """How a joint's servo follows its command in motion."""

    channels = ("tracking",)

    def track(self, term: Term, arm: Arm, q: Array, motion: Motion) -> Array:
        """Apply ``follow`` to each stretch without a gap in time."""
        if not motion.moving:
            return super().track(term, arm, q, motion)
        i, result = term.site.index, q.copy()
        for part in motion.stretches():
            first = float(motion.q[part.start, i])
            result[part, i] = self.follow(term, motion.t[part], q[part, i], first)
        return result

    @abstractmethod
    def follow(self, term: Term, time: Array, command: Array, first: float) -> Array:
        """Return the joint angles (N,), rad, at ``time`` (N,), s, for its command (N,), rad.

        ``first`` is its angle at the start of the stretch, rad.
        """


def rows_after(term: Term, loads: Loads) -> Any:
    """Return an index of the rows that are later than a term's moment; all where time is unknown.

    The moment is the term's last value.
    """
    return slice(None) if loads.time is None else loads.time > term.values[-1]


def typical_moment(arm: Arm, joint: int = 0) -> float:
    """Return a usual moment (Nm): the weight beyond a joint (from 1) at half its stretched length.

    With 0: of the whole arm. Used to scale parameters, and for bounds.
    """
    import numpy as np

    reach = float(np.linalg.norm(arm.link_in_link[joint:, :3, 3], axis=1).sum())
    mass = float(arm.mass[max(joint - 1, 0) :].sum())
    payload = arm.payload if math.isfinite(arm.payload) else 5.0
    return max(9.81 * (mass / 3 + payload) * max(reach, 0.1) / 2, 1.0)


def joint_scale(arm: Arm, site: Site) -> float:
    """Return a usual torque (Nm) of a joint: its rated effort, or what the arm's weight makes."""
    effort = float(arm.limits.effort[site.index])
    return effort if math.isfinite(effort) and effort > 0 else typical_moment(arm)
