"""The model: arm, tool, payload, gravity and effects; it predicts where the TCP really is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.effects import CATALOGUE, Site, Term, flexibility_effects, settling
from gapbridge.core.effects.effect import Effect
from gapbridge.core.errors import EquilibriumError, InputError
from gapbridge.core.kernels import many
from gapbridge.core.kernels.reference import Chain, Rows
from gapbridge.core.kernels.turns import rotation_vectors
from gapbridge.core.loads import Loads

SERVO_ROUNDS = 10  # fixed-point iterations of the servos' deflection
CONVERGED = 1e-10  # rad
STANDARD_GRAVITY = (0.0, 0.0, -9.80665)
Uncertain = Callable[[Array, Loads, Sequence[Term]], Array]
"""q (N, n), loads, known terms -> (N, 6, r): 1 sigma of poses by other parameters, m, rad."""


@dataclass(frozen=True)
class Poses:
    """Poses of the TCP in base."""

    position: Array  # (N, 3) m
    rotation: Array  # (N, 3, 3)

    @property
    def rotation_vector(self) -> Array:
        """Return the rotations as rotation vectors (N, 3), rad."""
        vectors = np.empty((len(self.rotation), 3))
        rotation_vectors(np.ascontiguousarray(self.rotation), vectors)
        return vectors


@dataclass(frozen=True)
class LinearForm:
    """Eq. 4 of docs/conventions.md at given shapes: pose change = ``regressor`` @ flexibilities."""

    regressor: Array  # (N, 6, 2n) m/(rad/Nm), Nm: axial 1..n, then radial 1..n
    jacobian: Array  # (N, 6, n) of the TCP, base axes
    moment: Array  # (N, n, 3) Nm, of everything beyond each joint, base axes


@dataclass(frozen=True)
class Model:
    """One arm in one cell. Immutable; the ``with_`` functions return changed copies."""

    arm: Arm
    tool_in_flange: Array = field(default_factory=lambda: np.eye(4))  # (4, 4)
    payload_mass: float = 0.0  # kg
    payload_cog: Array = field(default_factory=lambda: np.zeros(3))  # (3,) m, flange axes
    gravity: Array = field(default_factory=lambda: np.array(STANDARD_GRAVITY))  # base axes
    reference_temperature: float = 25.0  # °C
    terms: tuple[Term, ...] = ()

    @property
    def length(self) -> float:
        """Return the length of the stretched arm with its tool (m)."""
        return self.arm.length + float(np.linalg.norm(self.tool_in_flange[:3, 3]))

    @property
    def added_mass(self) -> float:
        """Return what the terms add to the declared payload (kg)."""
        return sum(t.values[0] for t in self.terms if CATALOGUE[t.effect].adds_mass)

    def with_terms(self, terms: Sequence[Term]) -> Model:
        """Return the model with further effects in it."""
        return replace(self, terms=self.terms + tuple(terms))

    def without_terms(self) -> Model:
        """Return the rigid, effect-free model."""
        return replace(self, terms=())

    def with_compliance(
        self, axial: Sequence[float] | Array, radial: Sequence[float] | Array
    ) -> Model:
        """Return the model with these joint flexibilities (n each, rad/Nm) instead of its own."""
        kept = [t for t in self.terms if not CATALOGUE[t.effect].flexibility]
        named = flexibility_effects()
        for effect, values in ((named["axial"], axial), (named["radial"], radial)):
            if len(values) != self.arm.n:
                raise InputError(f"{effect}: found {len(values)} values, expected {self.arm.n}")
            kept += [Term(effect, Site(i + 1), (float(v),)) for i, v in enumerate(values) if v]
        return replace(self, terms=tuple(kept))

    def compliance(self) -> tuple[Array, Array]:
        """Return the axial and radial joint flexibilities (n,), (n,) in rad/Nm."""
        chain = self.chain()
        return chain.compliance[:, 2].copy(), chain.compliance[:, 0].copy()

    def chain(self) -> Chain:
        """Return the kinematic chain with effects, the same for all rows."""
        arm, n = self.arm, self.arm.n
        chain = Chain(
            rotation=np.array(arm.link_in_link[:, :3, :3], dtype=float, order="C"),
            position=np.array(arm.link_in_link[:, :3, 3], dtype=float, order="C"),
            tool_rotation=np.array(self.tool_in_flange[:3, :3], dtype=float, order="C"),
            tool_position=np.array(self.tool_in_flange[:3, 3], dtype=float, order="C"),
            mass=np.array(arm.mass, dtype=float),
            cog=np.array(arm.cog, dtype=float, order="C"),
            gravity=np.array(self.gravity, dtype=float),
            compliance=np.zeros((n, 3)),
            softening=np.zeros(n),
            flexibility=np.zeros(n),
            base_compliance=np.zeros(3),
        )
        for term in self.terms:
            CATALOGUE[term.effect].shape(term, arm, chain)
        return chain

    def rows(self, q: Array, loads: Loads | None = None) -> Rows:
        """Return joint angles and loads per row with effects; ``q`` (N, n) are encoder angles.

        Raises InputError for arrays of other shapes: the kernels would read beyond them.
        """
        loads = loads or Loads()
        count, n = q.shape
        mass = np.full(count, float(self.payload_mass)) if loads.payload_mass is None else (
            np.array(loads.payload_mass, dtype=float, order="C")
        )  # fmt: skip
        cog = np.tile(self.payload_cog, (count, 1)) if loads.payload_cog is None else (
            np.array(loads.payload_cog, dtype=float, order="C")
        )  # fmt: skip
        wrench = np.zeros((count, 6)) if loads.wrench is None else (
            np.array(loads.wrench, dtype=float, order="C")
        )  # fmt: skip
        rows = Rows(np.array(q, dtype=float, order="C"), np.ones((count, n)), mass, cog, wrench)
        for name, found, expected in (
            ("q", rows.q, (count, self.arm.n)), ("payload_mass", mass, (count,)),
            ("payload_cog", cog, (count, 3)), ("wrench", wrench, (count, 6)),
        ):  # fmt: skip
            if found.shape != expected:
                raise InputError(f"{name}: found an array {found.shape}, expected {expected}")
        self.condition(rows, loads, q, self.conditions())
        return rows

    def conditions(self) -> tuple[Term, ...]:
        """Return the terms that change rows, not the chain alone."""
        base_hook = Effect.condition
        return tuple(t for t in self.terms if type(CATALOGUE[t.effect]).condition is not base_hook)

    def condition(self, rows: Rows, loads: Loads, q: Array, terms: Sequence[Term]) -> None:
        """Change ``rows`` in place by ``terms``; ``q`` is (N, n) encoder angles."""
        if terms and loads.temperature is not None:  # relative to the reference
            loads = replace(loads, temperature=loads.temperature - self.reference_temperature)
        for term in terms:
            CATALOGUE[term.effect].condition(term, self.arm, rows, loads, q)

    def predict(self, q: Array, loads: Loads | None = None) -> Poses:
        """Return the TCP poses in base for encoder angles ``q`` (N, n): the exact equilibrium.

        Loads act on the deflected arm. Raises InputError where a row has no equilibrium (the arm
        would buckle).
        """
        chain, rows = self.chain(), self.rows(np.atleast_2d(q), loads)
        count = len(rows.q)
        position, rotation = np.empty((count, 3)), np.empty((count, 3, 3))
        _require_equilibrium(many.predict(chain, rows, position, rotation))
        if loads is not None and loads.time is not None:
            for term in self.terms:
                CATALOGUE[term.effect].before(term, chain, position, rotation, loads)
        return Poses(position, rotation)

    def holding_torque(self, q: Array, loads: Loads | None = None) -> Array:
        """Return the motor torques (N, n), Nm, at rest at encoder angles ``q``.

        For gravity, payload and external wrench, about the axes of the deflected arm, positive
        towards positive q. Raises InputError where a row has no equilibrium.
        """
        form = self.linear_form(q, loads)
        return -np.asarray(np.einsum("nij,nji->ni", form.moment, form.jacobian[:, 3:]))

    def settled(self, commands: Array, loads: Loads | None = None) -> Array:
        """Return the encoder angles (N, n), rad, at rest for ``commands`` (N, n), rad."""
        terms, commands, loads = settling(self.terms), np.atleast_2d(commands), loads or Loads()
        q = commands
        for _ in range(SERVO_ROUNDS if terms else 0):
            torque, before, q = self.holding_torque(q, loads), q, commands
            for term in terms:
                q = CATALOGUE[term.effect].settle(term, self.arm, q, torque, loads.approach)
            if np.abs(q - before).max(initial=0.0) < CONVERGED:
                break
        return q

    def rigid_pose(self, q: Array) -> Poses:
        """Return the TCP poses of the rigid, effect-free arm at ``q`` (N, n)."""
        return self.without_terms().predict(q)

    def linear_form(self, q: Array, loads: Loads | None = None) -> LinearForm:
        """Return the linear form (eq. 4 of docs/conventions.md) at the model's present shape.

        For a model without compliance this is the paper's A(q, F), to be multiplied with the 2n
        flexibilities. Raises InputError where a row has no equilibrium.
        """
        chain, rows = self.chain(), self.rows(np.atleast_2d(q), loads)
        count, n = rows.q.shape
        form = LinearForm(
            np.zeros((count, 6, 2 * n)), np.zeros((count, 6, n)), np.zeros((count, n, 3))
        )
        _require_equilibrium(
            many.linear_form(chain, rows, form.regressor, form.jacobian, form.moment)
        )
        return form


def _require_equilibrium(bad: int) -> None:
    if bad >= 0:
        raise EquilibriumError(bad)
