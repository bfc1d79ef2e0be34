"""A verification in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gapbridge.core.calibration.result import Errors, Estimate
from gapbridge.core.effects import CATALOGUE

if TYPE_CHECKING:
    from gapbridge.core.calibration.verify import Suspect

FACTORS = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "kg": (1.0, "kg")}


def moved_text(moved: Suspect | None, suspects: Sequence[Suspect]) -> str:
    """Return what moved, and by how much."""
    if moved is None:
        if not suspects:
            return ""
        return "no single change of tool, load, instrument or one joint explains it: calibrate anew"
    kind, _, number = moved.name.rpartition("_")
    if kind == "reading":
        return f"reading {number} alone does not fit: measure it again"
    effect = CATALOGUE.get(moved.name) or CATALOGUE.get(kind)
    if effect is not None:
        return effect.moved.format(joint=number, size=_size(moved.estimates))
    return f"the instrument stands elsewhere, by {_size(moved.estimates)}: register it again"


def _size(estimates: Sequence[Estimate]) -> str:
    """Return how far lengths, angles and masses moved."""
    words = []
    for unit, (factor, unit_name) in FACTORS.items():
        own = [e for e in estimates if e.unit == unit]
        if not own:
            continue
        size = float(np.linalg.norm([e.value for e in own]))
        sure = float(np.sqrt(np.mean([e.std**2 for e in own])))
        if size > 2 * sure or len(estimates) == 1:
            words.append(f"{factor * size:.3g} {unit_name} (1 sigma {factor * sure:.2g})")
    return " and ".join(words) or "little"


def verdict_text(holds: bool, errors: Errors, ratio: float, chance: float, moved: str) -> str:
    """Return the verification in one sentence."""
    text = (
        f"{len(errors.rows)} poses are {1e3 * errors.rms:.3f} mm rms off, {ratio:.2f} times what "
        "the calibration predicted"
    )
    if holds:
        return f"the calibration holds: {text}"
    return f"the calibration no longer holds: {text} (chance {chance:.1g}); {moved}"
