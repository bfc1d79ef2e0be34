"""What changed from one cell to another: its keys, and the pose of the TCP over the workspace."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gapbridge.bridge.cell.cell import Cell
from gapbridge.bridge.cell.message import key_path
from gapbridge.core.arrays import Array
from gapbridge.core.effects import Site, Term
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_vector

POSES = 200
FIELDS = {  # part of a cell -> fields of its model
    "tool": ("tool_in_flange",),
    "payload": ("payload_mass", "payload_cog"),
    "gravity": ("gravity",),
    "reference_temperature": ("reference_temperature",),
}
LEFT_OUT = ("provenance",)  # where a value comes from is no value
WIDEST = np.pi  # rad: joints without limits are drawn within


@dataclass(frozen=True)
class Change:
    """One key that differs; None: it is not there."""

    key: str
    before: Any
    after: Any


@dataclass(frozen=True)
class Part:
    """One part of the model that differs, and how far it alone moves the predicted TCP.

    ``name`` is tool, payload, gravity, reference_temperature, or an effect, then with its terms
    ``before`` and ``after`` and where they sit.
    """

    name: str
    moved: Moved | None
    site: Site | None = None
    before: Term | None = None
    after: Term | None = None


@dataclass(frozen=True)
class Moved:
    """How far predicted TCP poses lie apart, over ``poses`` poses."""

    poses: int
    rms: float  # m
    largest: float  # m
    turned: float  # rad, largest
    where: Array  # (n,) rad: joints of the largest
    mean: Array  # (3,) m, base axes, after minus before

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON-able data, SI units."""
        return {
            "poses": self.poses, "rms": self.rms, "largest": self.largest, "turned": self.turned,
            "where": self.where.tolist(), "mean": self.mean.tolist(),
        }  # fmt: skip


def changes(before: Cell, after: Cell) -> list[Change]:
    """Return the keys whose values differ, defaults filled in."""
    one, other = (cell.file.model_dump(mode="json") for cell in (before, after))
    for name in LEFT_OUT:
        one.pop(name, None)
        other.pop(name, None)
    effects = [_by_name(data.pop("effects", [])) for data in (one, other)]
    found = list(_walk((), one, other))
    for name in sorted(effects[0].keys() | effects[1].keys()):
        pair = [listed.get(name) for listed in effects]
        if pair[0] != pair[1]:
            found.append(Change(f"effect {name}", *pair))
    return found


def _by_name(effects: list[dict[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for entry in effects:
        name = str(entry["effect"])
        if entry.get("joint") is not None:
            name += f" of joint {entry['joint']}"
        if entry.get("order") is not None:
            name += f", order {entry['order']:g}"
        found[name] = entry["parameters"]
    return found


def _walk(keys: tuple[str | int, ...], one: Any, other: Any) -> Iterator[Change]:
    if isinstance(one, dict) and isinstance(other, dict):
        for key in [*one, *(k for k in other if k not in one)]:
            yield from _walk((*keys, key), one.get(key), other.get(key))
    elif one != other:
        yield Change(key_path(keys), one, other)


def moved(before: Cell, after: Cell, q: Array | None = None, loads: Loads | None = None,
          seed: int = 0) -> Moved | None:  # fmt: skip
    """Return how far the predicted TCP moves from one cell to the other; None: other joints.

    ``q`` (N, n) in rad; left out: random poses within the joint limits, under each cell's payload.
    Poses in which an arm finds no equilibrium are left out.
    """
    if before.arm.n != after.arm.n:
        return None
    return _moved(before.model, after.model, _drawn(before, seed) if q is None else q, loads)


def parts(before: Cell, after: Cell, q: Array | None = None, loads: Loads | None = None,
          seed: int = 0) -> list[Part]:  # fmt: skip
    """Return the parts in which the models differ, the one that moves the TCP farthest first.

    Each is put by itself into the model of ``before``, over the poses of ``moved``. Empty where the
    arms have other joints.
    """
    if before.arm.n != after.arm.n:
        return []
    old, new = before.model, after.model
    q = _drawn(before, seed) if q is None else q
    found = [
        Part(name, _moved(old, replace(old, **{key: getattr(new, key) for key in keys}), q, loads))
        for name, keys in FIELDS.items()
        if any(not np.array_equal(getattr(old, key), getattr(new, key)) for key in keys)
    ]
    one, other = ({(t.effect, t.site): t for t in model.terms if any(t.values)}
                  for model in (old, new))  # fmt: skip
    for at in dict.fromkeys([*one, *other]):
        if one.get(at) != other.get(at):
            kept = [term for term in old.terms if (term.effect, term.site) != at]
            put = [other[at]] if at in other else []
            trial = replace(old, terms=(*kept, *put))
            found.append(Part(at[0], _moved(old, trial, q, loads), at[1], one.get(at),
                              other.get(at)))  # fmt: skip
    return sorted(found, key=lambda part: -(part.moved.rms if part.moved else 0.0))


def _drawn(cell: Cell, seed: int) -> Array:
    """Return random poses (POSES, n) within the joint limits, rad."""
    limits = cell.arm.limits
    low, high = np.maximum(limits.lower, -WIDEST), np.minimum(limits.upper, WIDEST)
    return np.random.default_rng(seed).uniform(low, high, (POSES, cell.arm.n))


def _moved(before: Model, after: Model, q: Array, loads: Loads | None) -> Moved | None:
    """Return how far predicted TCP poses lie apart; None: no pose with an equilibrium."""
    one, other = (model.predict(q, loads) for model in (before, after))
    apart = other.position - one.position
    fine = np.isfinite(apart).all(axis=1)
    if not fine.any():
        return None
    far = np.linalg.norm(apart[fine], axis=1)
    turn = np.swapaxes(one.rotation[fine], 1, 2) @ other.rotation[fine]
    return Moved(
        poses=int(fine.sum()),
        rms=float(np.sqrt(np.mean(far**2))),
        largest=float(far.max()),
        turned=float(np.linalg.norm(rotation_vector(turn), axis=1).max()),
        where=q[fine][int(np.argmax(far))],
        mean=apart[fine].mean(axis=0),
    )
