"""The changes that make a simulator model of the nominal arm behave as the cell's model.

Geometry, tool, gravity and springs are the difference of the chains with and without the cell's
effects; everything else is set by the effects themselves (``Effect.simulator``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.effects.effect import Effect, Term
from gapbridge.core.effects.simulator import Kind, SimulatorChange
from gapbridge.core.errors import InputError
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix, transform

MAX_ANGLE, MAX_DISTANCE = 1e-3, 1e-3  # rad, m, between a joint axis of the model and the cell's
TOLERANCE = 1e-12  # of a frame that counts as unchanged


@dataclass(frozen=True)
class Springs:
    """Flexibilities that the cell adds; n joints."""

    joint: Array  # (n, 3) rad/Nm about x, y, z (the axis) of each joint's frame
    softening: Array  # (n,) 1/(Nm)2 of the axial spring: theta = c M / sqrt(1 + softening M^2)
    link: Array  # (n,) 1/(N m2): 1/EI of the link after each joint
    base: Array  # (3,) rad/Nm about the base axes


@dataclass(frozen=True)
class Axes:
    """Lines of the joints' axes at zero angles, in one frame."""

    point: Array  # (n, 3) m
    direction: Array  # (n, 3) unit vectors


@dataclass(frozen=True)
class ModelChanges:
    """The changes of the nominal arm that the cell's effects make."""

    model: Model  # of the cell, effects included
    joint_in_base: Array  # (n+1, 4, 4) nominal frames at zero angles: joints, then the flange
    shift: Array  # (n+1, 4, 4) change of each nominal frame: joint_in_base @ shift
    tcp_in_base: Array  # (4, 4) nominal
    tcp_shift: Array  # (4, 4) change of tool_in_flange, with that of the flange
    gravity: Array | None  # (3,) m/s2 in base, None where the cell does not tilt it
    springs: Springs
    settings: tuple[SimulatorChange, ...]
    unsupported: tuple[tuple[str, str], ...]  # effect that no format supports, what to do instead
    skipped: tuple[str, ...] = ()  # a line for each stand-in; stand-ins are not written

    @property
    def n(self) -> int:
        """Return the number of joints."""
        return len(self.shift) - 1

    def axes(self) -> Axes:
        """Return the nominal axes in base."""
        frames = self.joint_in_base[: self.n]
        return Axes(frames[:, :3, 3], frames[:, :3, 2])

    def of_joint(self, kind: Kind, joint: int) -> float:
        """Return the sum of the settings of a kind at a joint (from 1)."""
        return sum(s.value for s in self.settings if (s.kind, s.joint) == (kind, joint))

    def vector(self, kind: Kind, joint: int | None = None) -> Array:
        """Return the sum (3,) of the settings of a kind that have axes, at a joint (from 1)."""
        total = np.zeros(3)
        for s in self.settings:
            if s.axis is not None and (s.kind, s.joint) == (kind, joint):
                total[s.axis] += s.value
        return total

    def is_one_link(self, joint: int, masses: Sequence[float]) -> bool:
        """Return whether a joint's body (its mass first) and those fixed to it are one link.

        After the last joint they can be the tool or the load, which the cell has elsewhere: its
        mass of that link decides. ``masses`` in kg.
        """
        if joint < self.n:
            return True
        of_link = self.model.arm.mass[-1]
        return bool(abs(sum(masses) - of_link) < abs(masses[0] - of_link))

    def motion(self, joint: int, base_in_world: Array) -> Array:
        """Return the motion (4, 4) in world of all bodies from a joint (from 0; n: flange) on."""
        frame = base_in_world @ self.joint_in_base[joint]
        return np.asarray(frame @ self.shift[joint] @ np.linalg.inv(frame))


def changes_of(model: Model) -> ModelChanges:
    """Return the changes of the nominal arm by a model's terms; stand-ins are left out."""
    stand_ins = tuple(dict.fromkeys(_term_name(t) for t in model.terms if t.stand_in))
    causes = [t for t in model.terms if not t.stand_in]
    outside_arm = _unsupported([t for t in causes if not CATALOGUE[t.effect].of_the_arm], model)
    arm_terms = [t for t in causes if CATALOGUE[t.effect].of_the_arm]
    model = model.without_terms().with_terms(arm_terms)
    nominal, real, arm = model.without_terms().chain(), model.chain(), model.arm
    n = arm.n
    steps = [transform(nominal.rotation[i], nominal.position[i]) for i in range(n + 1)]
    shift = np.array([
        np.linalg.inv(steps[i]) @ transform(real.rotation[i], real.position[i])
        for i in range(n + 1)
    ])  # fmt: skip
    settings = tuple(
        setting for term in model.terms
        for setting in CATALOGUE[term.effect].simulator(term, arm)
    )  # fmt: skip
    for setting in settings:
        if setting.kind is Kind.JOINT_ZERO and setting.joint is not None:
            turn = rotation_matrix(np.array([0.0, 0.0, setting.value]))
            shift[setting.joint - 1] = shift[setting.joint - 1] @ transform(turn, np.zeros(3))
    frames = [steps[0]]
    for step in steps[1:]:
        frames.append(frames[-1] @ step)
    tool = transform(nominal.tool_rotation, nominal.tool_position)
    real_tool = transform(real.tool_rotation, real.tool_position)
    tilted = not np.allclose(real.gravity, nominal.gravity, rtol=0, atol=1e-12)
    springs = Springs(real.compliance, real.softening, real.flexibility, real.base_compliance)
    return ModelChanges(
        model, np.array(frames), shift, frames[-1] @ tool,
        np.linalg.inv(tool) @ shift[n] @ real_tool, real.gravity if tilted else None, springs,
        settings, (*_unsupported(arm_terms, model), *outside_arm),
        tuple(f"{name}: a stand-in, not a confirmed cause" for name in stand_ins),
    )  # fmt: skip


def _term_name(term: Term) -> str:
    return term.effect + ("" if term.site.joint is None else f" of joint {term.site.joint}")


def _unsupported(terms: Sequence[Term], model: Model) -> tuple[tuple[str, str], ...]:
    """Return the effects that neither the chain nor a simulator's settings can represent."""
    texts: dict[str, str] = {}
    for term in terms:
        effect = CATALOGUE[term.effect]
        in_chain = effect.of_the_arm and type(effect).shape is not Effect.shape
        if not in_chain and not effect.simulator(term, model.arm):
            texts[effect.identifier] = effect.simulator_advice
    return tuple(texts.items())


def base_in_world(cell_axes: Axes, model_axes: Axes, source: str, names: tuple[str, ...]) -> Array:
    """Return the pose (4, 4) of the cell's base in the world of a user's model.

    The rotation that aligns the directions of the cell's axes with the model's (Kabsch), then the
    shift that aligns the lines (least squares). Raises InputError, naming the first joint whose
    axis does not agree: the model is of another arm, or has another zero; and where all axes are
    parallel, which determine neither a turn about them nor a shift along them.
    """
    parallel = np.linalg.norm(np.cross(cell_axes.direction, cell_axes.direction[0]), axis=1)
    if parallel.max() < MAX_ANGLE:
        raise InputError(
            f"{source}: joints {', '.join(names)}: found axes that are all parallel, expected two "
            "directions: these do not show where the model has the cell's base"
        )
    U, _, Vt = np.linalg.svd(model_axes.direction.T @ cell_axes.direction)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    across = np.array([np.eye(3) - np.outer(d, d) for d in model_axes.direction])
    offset = model_axes.point - cell_axes.point @ R.T
    t = np.linalg.lstsq(across.reshape(-1, 3), np.einsum("nij,nj->ni", across, offset).ravel(),
                        rcond=1e-9)[0]  # fmt: skip
    rotated, distance = cell_axes.direction @ R.T, np.einsum("nij,nj->ni", across, offset - t)
    for name, a, b, d in zip(names, rotated, model_axes.direction, distance, strict=True):
        angle = float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
        if angle > MAX_ANGLE or np.linalg.norm(d) > MAX_DISTANCE:
            raise InputError(
                f"{source}: joint {name}: found its axis {np.degrees(angle):.3g} deg and "
                f"{1e3 * np.linalg.norm(d):.3g} mm off the cell's nominal arm at zero angles, "
                "expected the same arm with the same zero"
            )
    return transform(R, t)
