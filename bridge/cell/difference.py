"""The differences of two cells: their keys, and how far the predicted TCP moves."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gapbridge.bridge.cell.cell import Cell
from gapbridge.core.arrays import Array
from gapbridge.core.effects import Site, Term
from gapbridge.core.errors import EquilibriumError, key_path
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model, Poses
from gapbridge.core.rotation import rotation_vector

POSES = 200
MODEL_FIELDS = {  # key of a cell -> fields of its model
    "tool": ("tool_in_flange",),
    "payload": ("payload_mass", "payload_cog"),
    "gravity": ("gravity",),
    "reference_temperature": ("reference_temperature",),
}
MODEL_KEYS = (*MODEL_FIELDS, "compliance")
IGNORED_KEYS = ("provenance",)
MAX_ANGLE = np.pi  # rad: bound of random poses, for joints without limits


@dataclass(frozen=True)
class KeyChange:
    """One key that differs; None: the cell does not have it."""

    key: str
    before: Any
    after: Any
    in_model: bool  # a part of the model, which ``part_changes`` reports too

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON-able data."""
        return {"key": self.key, "before": self.before, "after": self.after}


@dataclass(frozen=True)
class PartChange:
    """One part of the model that differs, and how far it alone moves the predicted TCP.

    ``name`` is tool, payload, gravity, reference_temperature or an effect; an effect has a site
    and its terms there ``before`` and ``after``, several of which add up (none: the cell does not
    have it).
    """

    name: str
    shift: TcpShift | None
    site: Site | None = None
    before: tuple[Term, ...] = ()
    after: tuple[Term, ...] = ()


@dataclass(frozen=True)
class TcpShift:
    """Distance of the TCP poses that two models predict, over ``poses`` poses."""

    poses: int
    rms: float  # m
    largest: float  # m
    turned: float  # rad, largest rotation
    where: Array  # (n,) rad: joint angles of the largest distance
    mean: Array  # (3,) m, base axes, after minus before

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON-able data, SI units."""
        return vars(self) | {"where": self.where.tolist(), "mean": self.mean.tolist()}


def key_changes(before: Cell, after: Cell) -> list[KeyChange]:
    """Return the keys whose values differ, defaults filled in."""
    one, other = (cell.file.model_dump(mode="json") for cell in (before, after))
    for name in IGNORED_KEYS:
        one.pop(name, None)
        other.pop(name, None)
    effects = [_effects_by_name(data.pop("effects", [])) for data in (one, other)]
    changes = list(_key_differences((), one, other))
    for name in sorted(effects[0].keys() | effects[1].keys()):
        old, new = (listed.get(name) for listed in effects)
        if old != new:
            changes.append(KeyChange(f"effect {name}", old, new, in_model=True))
    return changes


def _effects_by_name(effects: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the parameters of each effect at its joint; a list of them where it is there twice."""
    parameters: dict[str, list[Any]] = {}
    for entry in effects:
        name = str(entry["effect"])
        if entry.get("joint") is not None:
            name += f" of joint {entry['joint']}"
        if entry.get("order") is not None:
            name += f", order {entry['order']:g}"
        parameters.setdefault(name, []).append(entry["parameters"])
    return {
        name: found[0] if len(found) == 1 else sorted(found, key=str)
        for name, found in parameters.items()
    }


def _key_differences(keys: tuple[str | int, ...], one: Any, other: Any) -> Iterator[KeyChange]:
    if isinstance(one, dict) and isinstance(other, dict):
        for key in [*one, *(k for k in other if k not in one)]:
            yield from _key_differences((*keys, key), one.get(key), other.get(key))
    elif one != other:
        yield KeyChange(key_path(keys), one, other, in_model=keys[0] in MODEL_KEYS)


def tcp_shift(before: Cell, after: Cell, q: Array, loads: Loads | None) -> TcpShift | None:
    """Return how far the predicted TCP moves from one cell to the other at ``q`` (N, n), rad.

    Without ``loads`` under each cell's payload. Poses without equilibrium are left out. None if the
    arms have different numbers of joints, or no pose has an equilibrium.
    """
    if before.arm.n != after.arm.n:
        return None
    return _model_shift(before.model, after.model, q, loads)


def part_changes(before: Cell, after: Cell, q: Array, loads: Loads | None) -> list[PartChange]:
    """Return the parts in which the models differ, sorted by the shift of the TCP, largest first.

    Each part alone is replaced in the model of ``before``, over the poses of ``tcp_shift``. Empty
    if the arms have different numbers of joints.
    """
    if before.arm.n != after.arm.n:
        return []
    old, new = before.model, after.model
    parts = [
        PartChange(
            name, _model_shift(old, replace(old, **{k: getattr(new, k) for k in keys}), q, loads)
        )
        for name, keys in MODEL_FIELDS.items()
        if any(not np.array_equal(getattr(old, k), getattr(new, k)) for k in keys)
    ]
    one, other = _terms_by_site(old), _terms_by_site(new)
    for key in dict.fromkeys([*one, *other]):
        was, now = one.get(key, ()), other.get(key, ())
        if was != now:
            kept = [term for term in old.terms if (term.effect, term.site) != key]
            shift = _model_shift(old, replace(old, terms=(*kept, *now)), q, loads)
            parts.append(PartChange(key[0], shift, key[1], was, now))
    return sorted(parts, key=lambda part: -(part.shift.rms if part.shift else 0.0))


def _terms_by_site(model: Model) -> dict[tuple[str, Site], tuple[Term, ...]]:
    """Return the terms of each effect at each site, in order of their values."""
    found: dict[tuple[str, Site], tuple[Term, ...]] = {}
    for term in sorted((t for t in model.terms if any(t.values)), key=lambda t: t.values):
        key = term.effect, term.site
        found[key] = (*found.get(key, ()), term)
    return found


def random_poses(cell: Cell, seed: int) -> Array:
    """Return random poses (POSES, n) within the joint limits, rad."""
    limits = cell.arm.limits
    low, high = np.maximum(limits.lower, -MAX_ANGLE), np.minimum(limits.upper, MAX_ANGLE)
    return np.random.default_rng(seed).uniform(low, high, (POSES, cell.arm.n))


def _model_shift(before: Model, after: Model, q: Array, loads: Loads | None) -> TcpShift | None:
    """Return how far the predicted TCP moves; None: no pose has an equilibrium."""
    one, other = (_predicted(model, q, loads) for model in (before, after))
    shift = other.position - one.position
    valid = np.isfinite(shift).all(axis=1)
    if not valid.any():
        return None
    distance = np.linalg.norm(shift[valid], axis=1)
    turn = np.swapaxes(one.rotation[valid], 1, 2) @ other.rotation[valid]
    return TcpShift(
        poses=int(valid.sum()),
        rms=float(np.sqrt(np.mean(distance**2))),
        largest=float(distance.max()),
        turned=float(np.linalg.norm(rotation_vector(turn), axis=1).max()),
        where=q[valid][int(np.argmax(distance))],
        mean=shift[valid].mean(axis=0),
    )


def _predicted(model: Model, q: Array, loads: Loads | None) -> Poses:
    """Return the poses of the TCP, NaN where the arm has no equilibrium."""
    try:
        return model.predict(q, loads)
    except EquilibriumError:
        found = Poses(np.full((len(q), 3), np.nan), np.full((len(q), 3, 3), np.nan))
    for r in range(len(q)):
        row = slice(r, r + 1)
        with contextlib.suppress(EquilibriumError):
            pose = model.predict(q[row], None if loads is None else loads[row])
            found.position[row], found.rotation[row] = pose.position, pose.rotation
    return found
