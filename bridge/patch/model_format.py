"""The base of the formats that a cell's effects can be written into."""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from gapbridge.bridge.patch.changes import ModelChanges
from gapbridge.core.errors import InputError
from gapbridge.core.log.sources.joint_order import order_joints

MARK = "Patched by gapbridge."  # first line of a patched model's comment


@dataclass(frozen=True)
class PatchOptions:
    """The user's options for a model."""

    joints: tuple[str, ...] = ()  # its joints, in the order of the arm's
    tcp: str = ""  # its TCP: a site, link or prim
    load: str = ""  # its body that models the declared payload
    on_top: bool = False  # diagnosed against this simulator: add to what its joints and servos have
    folder: Path | None = None  # of the patched model, if not the model's own

    def total(self, found: float, own: float) -> float:
        """Return a joint's or servo's value, of which the model has ``own``.

        Without ``on_top`` the cell's model had none of it: the cell has found all of it.
        """
        return found + own if self.on_top else found


@dataclass(frozen=True)
class Patched:
    """A patched model and what was done to it."""

    text: str
    changed: tuple[str, ...]  # one line per change
    unsupported: tuple[str, ...]  # one line each: what the format cannot represent, what to do


class ModelFormat(ABC):
    """One format of models."""

    suffixes: ClassVar[tuple[str, ...]]
    text_suffixes: ClassVar[tuple[str, ...]]  # of those: the ones of a patched model, a text
    holds_load: ClassVar[bool] = False  # whether a body of it can be named as the payload

    @abstractmethod
    def patch(self, path: Path, changes: ModelChanges, options: PatchOptions,
              notes: Sequence[str]) -> Patched:  # fmt: skip
        """Return the model at ``path`` with the changes in it; ``notes`` are added as comments.

        Raises InputError where the model cannot be read, is of another arm, or its joints cannot
        be assigned to the arm's.
        """


def require_original(path: Path, options: PatchOptions) -> None:
    """Raise InputError for a model that was patched already, unless the cell adds to it."""
    if not options.on_top and MARK.encode() in path.read_bytes():
        raise InputError(
            f"{path}: found a model that was patched already, expected the original one: what the "
            "cell holds would be in it twice (a cell diagnosed with --sim may add to it)"
        )


def pick_joints(
    path: Path, names_in_model: Sequence[str], changes: ModelChanges, options: PatchOptions
) -> tuple[str, ...]:
    """Return the model's joint names in the order of the arm's. Raises InputError."""
    n = changes.n
    arm = changes.model.arm.joint_names or tuple(f"joint_{i + 1}" for i in range(n))
    names = order_joints(path, names_in_model, arm, options.joints)
    if len(names) != n:
        raise InputError(
            f"{path}: joints: found {len(names)} ({', '.join(names)}), expected {n} as the "
            "cell's arm has"
        )
    return names


def known_name(path: Path, option: str, name: str, names: Sequence[str]) -> str:
    """Return ``name`` if the model has it or it is ''; raises InputError with the nearest name."""
    if not name or name in names:
        return name
    matches = difflib.get_close_matches(name, names, n=1)
    hint = f"; did you mean {matches[0]}?" if matches else f": {', '.join(names) or 'none'}"
    raise InputError(f"{path}: {option}: found {name}, expected one that the model has{hint}")
