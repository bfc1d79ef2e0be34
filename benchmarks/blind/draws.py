"""Random effects of the position channel, in credible shapes; their sizes are set by their gap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from benchmarks.blind import ingredients as put
from benchmarks.blind.arms import ArmKind
from benchmarks.blind.ingredients import Ingredient
from benchmarks.blind.measuring import axial_moments
from benchmarks.blind.mechanics import RealArm, Session

PER_JOINT = (
    "joint_offset", "link_geometry", "transmission_error", "axial_compliance",
    "radial_compliance", "link_flexibility", "stiffness_nonlinearity", "backlash", "joint_slip",
)  # fmt: skip
WHOLE_ARM = (
    "tool_frame", "base_compliance", "gravity_direction", "payload", "thermal_drift",
    "target_slip", "payload_cog",
)  # fmt: skip
POSITION_EFFECTS = PER_JOINT + WHOLE_ARM
NEEDS_COMPLIANCE = ("gravity_direction", "payload", "payload_cog")
# gap over floor: most effects are clear, some are small by nature
RATIO = {
    "gravity_direction": (2.0, 6.0), "thermal_drift": (2.0, 6.0), "payload": (2.0, 10.0),
    "payload_cog": (2.0, 8.0),
    "link_flexibility": (3.0, 12.0), "stiffness_nonlinearity": (5.0, 15.0),
}  # fmt: skip


ONE_OF = {"axial_compliance", "stiffness_nonlinearity"}  # the second holds the first


def some_effects(count: int, rng: Generator) -> tuple[str, ...]:
    """Return that many different effects at random, never a joint's softness twice."""
    while True:
        chosen = tuple(str(e) for e in rng.choice(POSITION_EFFECTS, count, replace=False))
        if not set(chosen) >= ONE_OF:
            return chosen


class Redraw(Exception):  # noqa: N818 - not an error: this draw does not show, take another
    """Raised where a draw would not show in the data, or only at an incredible size."""


def sites(effect: str, kind: ArmKind) -> list[int]:
    """Return the joints (from 1) where an effect can be put."""
    if effect == "link_geometry":
        return list(range(1, kind.n))
    if effect == "link_flexibility":
        return [i + 1 for i, r in enumerate(kind.rows[:-1]) if abs(r.a) + abs(r.d) > 0.05]
    return list(range(1, kind.n + 1))


def draw(
    effect: str, joint: int | None, kind: ArmKind, arm: RealArm, session: Session,
    with_rotation: bool, rng: Generator,
) -> list[Ingredient]:  # fmt: skip
    """Return an effect with random shape at a joint, in some first size."""
    if effect == "tool_frame":
        turn = rng.normal(size=3) * 2e-3 if with_rotation else np.zeros(3)
        return [put.tool_frame(rng.normal(size=3) * 1e-3, turn)]
    if effect == "base_compliance":
        soft = 5 * kind.radial[0]
        y = 1.0 if rng.random() < 0.2 else float(np.exp(rng.choice([-1, 1]) * rng.uniform(0.7, 2)))
        return [put.base_compliance(soft, soft * y, 20 * soft)]
    if effect == "gravity_direction":
        return [put.gravity_direction(*(rng.normal(size=2) * 0.02))]
    if effect == "payload":
        return [put.payload(0.1 * kind.rated, 0.6 * kind.rated)]
    if effect == "thermal_drift":
        return [put.thermal_drift(1.5e-5)]
    if effect == "target_slip":
        return [put.target_slip(rng.normal(size=3) * 1e-3, _moment(session, rng))]
    if effect == "payload_cog":
        return [put.payload_cog(rng.normal(size=3) * 0.02, 1.5 * kind.tool)]
    assert joint is not None
    return _JOINT_DRAWS[effect](joint, Site(kind, arm, session, rng))


def _moment(session: Session, rng: Generator) -> float:
    """Return a moment (s) of a session, away from its ends."""
    return float(np.quantile(session.time, rng.uniform(0.15, 0.85)))


@dataclass(frozen=True)
class Site:
    """What a draw at one joint may look at."""

    kind: ArmKind
    arm: RealArm
    session: Session
    rng: Generator


def _joint_offset(j: int, at: Site) -> list[Ingredient]:
    return [put.joint_offset(j, at.rng.choice([-1, 1]) * 1e-3)]


def _link_geometry(j: int, at: Site) -> list[Ingredient]:
    keys = ["a", "d", "alpha"]
    if abs(np.sin(at.kind.rows[j - 1].alpha)) < 1e-6:
        keys.append("beta")
    chosen = at.rng.permutation(keys)[: at.rng.integers(1, 4)]
    scale = {"a": 5e-4, "d": 5e-4, "alpha": 8e-4, "beta": 8e-4}
    return [put.link_geometry(j, {k: at.rng.normal() * scale[k] for k in keys if k in chosen})]


def _transmission(j: int, at: Site) -> list[Ingredient]:
    lines = 1 if at.rng.random() < 0.65 else 2
    many = int(at.rng.integers(8, 130))
    orders = (
        at.rng.permutation([1, 2, many, many])[:2] if lines == 2 else [at.rng.choice([1, 2, many])]
    )
    return [
        put.transmission_error(
            j, float(o), 3e-4 * at.rng.uniform(0.7, 1.4), at.rng.uniform(-np.pi, np.pi)
        )
        for o in sorted({int(o) for o in orders})
    ]


def _axial(j: int, at: Site) -> list[Ingredient]:
    return [put.axial_compliance(j, at.kind.axial[j - 1], 10 * at.kind.axial[j - 1])]


def _radial(j: int, at: Site) -> list[Ingredient]:
    return [put.radial_compliance(j, at.kind.radial[j - 1], 15 * at.kind.radial[j - 1])]


def _link_flexibility(j: int, at: Site) -> list[Ingredient]:
    row = at.kind.rows[j - 1]
    soft = at.kind.axial[j - 1] / max(float(np.hypot(row.a, row.d)), 0.1)
    return [put.link_flexibility(j, soft, 10 * soft)]


def _nonlinear(j: int, at: Site) -> list[Ingredient]:
    usual = float(np.quantile(np.abs(axial_moments(at.arm, at.session)[:, j - 1]), 0.9))
    if usual < 1e-3 * at.kind.rated:
        raise Redraw
    soft = at.kind.axial[j - 1]
    return [put.stiffness_nonlinearity(j, soft, usual * at.rng.uniform(0.2, 0.6), 15 * soft)]


def _joint_slip(j: int, at: Site) -> list[Ingredient]:
    return [put.joint_slip(j, at.rng.choice([-1, 1]) * 1e-3, _moment(at.session, at.rng))]


def _backlash(j: int, at: Site) -> list[Ingredient]:
    return [put.backlash(j, 3e-4)]


_JOINT_DRAWS: dict[str, Callable[[int, Site], list[Ingredient]]] = {
    "joint_offset": _joint_offset,
    "link_geometry": _link_geometry,
    "transmission_error": _transmission,
    "axial_compliance": _axial,
    "radial_compliance": _radial,
    "link_flexibility": _link_flexibility,
    "stiffness_nonlinearity": _nonlinear,
    "backlash": _backlash,
    "joint_slip": _joint_slip,
}
