"""Candidates: the hypotheses that may explain a gap, each with its columns.

A *named* candidate is an effect of the catalogue at one site; a *smooth* one is an unnamed function
of one quantity (if it is selected, the gap is ``unexplained``). Columns are derivatives of the
channel's full prediction, by central differences, at the current model.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import MIN_CYCLES
from gapbridge.core.diagnosis.observation import HELD_TORQUE, Observation
from gapbridge.core.effects import CATALOGUE, Effect, Parameter, Site, Term
from gapbridge.core.errors import InputError

STEP = 1e-2  # of a parameter's usual scale, for central differences
WHOLE_ORDERS = 128  # cycles per turn: periodic lines up to this order are candidates
HALF_ORDERS = 40  # up to here also at half orders
# (joint's typical moment / M0)^2, the softening values of the candidates of a stiffness curve
SOFTENING = tuple(float(v) for v in np.geomspace(0.02, 100, 13))

UNNAMED = Effect()


@dataclass(frozen=True)
class Candidate:
    """One hypothesis: columns (m, d) in the flattened, whitened sample space."""

    family: str  # the effect's identifier, or 'smooth'
    site: Site
    parameters: tuple[Parameter, ...]
    fixed: tuple[float | None, ...]  # per parameter of the effect; None: fitted
    curve: float | None = None  # softening of a stiffness curve (columns: linear, softening part)
    tried: int = 1  # hypotheses from which this one was selected
    quantity: str = ""  # the quantity that a smooth candidate is a function of
    target: str = ""  # the joint, axis or frame that it moves
    requires: str = ""  # family without which it changes no prediction
    whole: tuple[Parameter, ...] = ()  # with those fixed in its columns, bounded; (): as nominal
    jumps: bool = False  # a smooth candidate: 0 before one time, constant after it

    @property
    def named(self) -> bool:
        """Return whether this is a member of the catalogue."""
        return self.family != "smooth"

    @cached_property
    def scales(self) -> Array:
        """Return the usual size (d,) of each parameter."""
        return np.array([p.scale for p in self.parameters])

    @property
    def effect(self) -> Effect:
        """Return the member of the catalogue; of what is in none, an effect without attributes."""
        return CATALOGUE.get(self.family, UNNAMED)

    @property
    def turns_joint_by_own_angle(self) -> bool:
        """Return whether this is an angle error of a joint as a function of its own angle."""
        own = Effect.angle_columns
        return type(self.effect).angle_columns is not own

    @property
    def periodic(self) -> bool:
        """Return whether this is one line of a periodic effect."""
        return self.effect.periodic

    @property
    def without_quantity(self) -> bool:
        """Return whether this is an unnamed cause that is no function of a quantity."""
        return not self.named and not self.quantity

    @property
    def of_held_torque(self) -> bool:
        """Return whether this moves a joint by a function of the torque that it holds."""
        own = target_of(self.quantity, HELD_TORQUE)
        return bool(own) and self.target == own

    @property
    def of_own_speed(self) -> bool:
        """Return whether this moves a joint by a function of its own speed."""
        own = target_of(self.quantity, "actual_qd", "target_qd")
        return bool(own) and self.target == own

    def term(self, x: Array) -> Term:
        """Return the term with fitted values ``x`` (d,)."""
        if self.curve is not None:
            return Term(self.family, self.site, (float(np.sum(x)), self.curve))
        free = iter(float(v) for v in x)
        values = tuple(next(free) if f is None else f for f in self.fixed)
        return Term(self.family, self.site, values)


def joint_target(joint: int) -> str:
    """Return the name under which smooth candidates move a joint (from 1)."""
    return f"joint_{joint}"


def target_of(quantity: str, *columns: str) -> str:
    """Return the target of the joint that a quantity of one of these columns is of ('' if none)."""
    column, _, index = quantity.rpartition("_")
    return joint_target(int(index) + 1) if column in columns else ""


def named_candidates(
    arm: Arm,
    channel: str,
    withheld: Iterable[str] = (),
    with_rotation: bool = False,
    base: Sequence[Term] = (),
    turns: Sequence[float] = (),
) -> list[Candidate]:
    """Return the catalogue's members for a channel, at every site of the arm.

    Effects in ``base`` (the current model) come with their period or curve. ``turns`` (n,) is how
    many turns each joint's poses span.
    """
    candidates = []
    for identifier, effect in CATALOGUE.items():
        if channel not in effect.channels or identifier in set(withheld) or effect.at_moment:
            continue
        for site in effect.sites(arm):
            in_model = [t for t in base if t.effect == identifier and t.site.joint == site.joint]
            parameters = effect.parameters(arm, site)
            candidates += _variants(effect, parameters, site, with_rotation, in_model, turns)
    return candidates


def _variants(
    effect: Effect, parameters: tuple[Parameter, ...], site: Site, with_rotation: bool,
    in_model: Sequence[Term], turns: Sequence[float],
) -> list[Candidate]:  # fmt: skip
    """Return an effect's candidates at one site, one for each order, curve or shape it may have.

    ``in_model`` are the terms of the effect that the model already has at this joint.
    """
    identifier = effect.identifier
    free: tuple[float | None, ...] = (None,) * len(parameters)
    if effect.periodic:
        return [
            Candidate(identifier, Site(site.joint, order), parameters, free)
            for order in _orders(site, in_model, turns)
        ]
    if effect.has_nonlinearity and not in_model:
        linear = (replace(parameters[0], lower=-np.inf),) * 2
        return [
            Candidate(identifier, site, linear, free, curve=s * parameters[1].scale)
            for s in SOFTENING
        ]
    if effect.start_values:
        present = {t.values[-1] for t in in_model}
        return [
            Candidate(identifier, site, parameters[:-1], (*free[:-1], shape))
            for shape in (*effect.start_values, *(present - {*effect.start_values}))
        ]
    if any(p.of_rotation for p in parameters) and not with_rotation:
        shown = tuple(p for p in parameters if not p.of_rotation)
        held = tuple(0.0 if p.of_rotation else None for p in parameters)
        return [Candidate(identifier, site, shown, held)]
    return [Candidate(identifier, site, parameters, free)]


def _orders(site: Site, in_model: Sequence[Term], turns: Sequence[float]) -> list[float]:
    """Return the orders, in cycles a turn, of the lines that a joint may have."""
    orders = {
        *map(float, range(1, WHOLE_ORDERS + 1)),
        *(n / 2 for n in range(2, 2 * HALF_ORDERS + 1)),
        *(float(t.site.order) for t in in_model if t.site.order is not None),
    }
    # one cycle per turn is a usual period; of others, the range has to show more than one
    shown = turns[site.joint - 1] if site.joint and turns else 1.0
    min_order = min(MIN_CYCLES / max(shown, 1e-6), 3.0)
    return [order for order in sorted(orders) if order >= min_order or order in (1.0, 2.0)]


def named_columns(observation: Observation, candidate: Candidate, base: Sequence[Term]) -> Array:
    """Return d prediction / d parameter (N, k, d), with the ``base`` terms in the model."""
    if candidate.effect.periodic:
        by_angle = angle_columns(observation, candidate)
        if by_angle is not None:
            return by_angle
    if candidate.curve is not None:
        return _stiffness_curve_columns(observation, candidate)
    for term in base:
        kind = CATALOGUE[term.effect]
        own = candidate.family in (term.effect, kind.replaces)
        if kind.has_nonlinearity and own and term.site.joint == candidate.site.joint:
            return _columns_beside_curve(observation, candidate, base, term)
    columns = _from_nominal(observation, candidate, base)
    mass = candidate.effect.identifiable_with
    if mass is not None and not columns.any():  # a load without mass has no centre of gravity
        columns = _from_nominal(observation, candidate, [*base, mass])
    return columns


def changes_prediction_alone(observation: Observation, candidate: Candidate) -> bool:
    """Return whether an effect changes predictions without any other in the model."""
    return bool(_from_nominal(observation, candidate, ()).any())


def with_requirement(observation: Observation, candidate: Candidate) -> Candidate:
    """Return the candidate with the family that it requires (a centre of gravity, a load)."""
    needed = candidate.effect.identifiable_with
    if needed is None or changes_prediction_alone(observation, candidate):
        return candidate
    return replace(candidate, requires=needed.effect)


def jacobian(
    observation: Observation, candidate: Candidate, x: Array, others: Sequence[Term]
) -> Array:
    """Return d prediction / d parameter (N, k, d) at values ``x`` (d,), ``others`` in the model.

    Zeros where the arm has no equilibrium: there only the prior determines the step.
    """
    columns = []
    others = _interacting(candidate.effect, others)
    for k, parameter in enumerate(candidate.parameters):
        h = np.zeros(len(x))
        h[k] = STEP * parameter.scale
        try:
            ahead = observation.predict([*others, candidate.term(x + h)])
            behind = observation.predict([*others, candidate.term(x - h)])
        except InputError:
            ahead = behind = observation.measured
        columns.append((ahead - behind) / (2 * h[k]))
    return np.stack(columns, axis=-1)


def _interacting(effect: Effect, others: Sequence[Term]) -> Sequence[Term]:
    """Return the terms without which an effect's derivatives would differ.

    Torques that add up cancel in a difference, except for loads where friction depends on them.
    """
    if not effect.adds_torque:
        return others
    kinds = {t.effect: CATALOGUE[t.effect] for t in others}
    rubbing = effect.depends_on_load or (
        effect.loads_joints and any(kind.depends_on_load for kind in kinds.values())
    )

    def cancels(other: Effect) -> bool:
        return other.adds_torque and not (rubbing and (other.loads_joints or other.depends_on_load))

    return [t for t in others if not cancels(kinds[t.effect])]


def _from_nominal(observation: Observation, candidate: Candidate, base: Sequence[Term]) -> Array:
    """Return the Jacobian (N, k, d) of a candidate that is not in the model yet."""
    return jacobian(observation, candidate, np.zeros(len(candidate.parameters)), base)


def angle_columns(observation: Observation, candidate: Candidate) -> Array | None:
    """Return exact columns (N, k, d) of angle errors by the own angle; None for other effects."""
    J, joint = observation.joint_columns, candidate.site.joint
    if J is None or joint is None:
        return None
    angle = observation.quantities.get(joint_quantity(observation, joint - 1))
    constant = np.zeros(len(J))  # a joint that never moves has one angle
    shape = candidate.effect.angle_columns(candidate.site, constant if angle is None else angle)
    return None if shape is None else J[:, :, joint - 1, None] * shape[:, None, :]


def _stiffness_curve_columns(observation: Observation, candidate: Candidate) -> Array:
    """Return the columns (N, k, 2) of a stiffness curve: linear part and softening part.

    Both, because the joint may already be compliant in the model.
    """
    i, moment = (candidate.site.joint or 1) - 1, observation.axial_moment
    assert moment is not None and candidate.curve is not None
    linear_part = observation.axial_columns()[:, :, i]
    softened = 1 / np.sqrt(1 + candidate.curve * moment[:, i] ** 2)
    return np.stack([linear_part, linear_part * softened[:, None]], axis=-1)


def _columns_beside_curve(
    observation: Observation, candidate: Candidate, base: Sequence[Term], curve: Term
) -> Array:
    """Return columns (N, k, d) of a joint's stiffness whose ``curve`` is in the model.

    A straight line is that without the curve, and the curve is a chord from this line to its
    values, so that both are exact and compete on their full predictions: the tangent of a curve
    bent to half its slope is five times too short, and along it a line would follow the curve.
    """
    others = [t for t in base if t is not curve]
    straight = _from_nominal(observation, candidate, others)
    compliance, softening = curve.values
    if candidate.family != curve.effect or not softening:
        return straight
    part = observation.predict(base) - observation.predict(others)
    bend = (part - straight[..., 0] * compliance) / softening
    return np.stack([straight[..., 0], bend], axis=-1)


def joint_quantity(observation: Observation, i: int) -> str:
    """Return the name of the column with joint i's angle."""
    name = f"actual_q_{i}"
    return name if name in observation.quantities else f"target_q_{i}"
