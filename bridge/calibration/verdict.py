"""A verification in words: whether the calibration holds, and what moved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.core.calibration.result import Estimate
from gapbridge.core.calibration.verify import Suspect, Verification
from gapbridge.core.effects import CATALOGUE

FACTORS = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "kg": (1.0, "kg")}


def verdict_text(found: Verification) -> str:
    """Return the verification in one sentence."""
    errors = found.errors
    text = (
        f"{len(errors.rows)} poses are {1e3 * errors.rms:.3f} mm rms off, {found.ratio:.2f} times "
        "what the calibration predicted"
    )
    if found.holds:
        return f"the calibration holds: {text}"
    moved = (
        "no single change of tool, load, instrument or one joint explains it: calibrate anew"
        if found.moved is None
        else moved_text(found.moved)
    )
    return f"the calibration no longer holds: {text} (chance {found.chance:.1g}); {moved}"


def moved_text(moved: Suspect) -> str:
    """Return what moved, and by how much."""
    kind, _, number = moved.name.rpartition("_")
    if kind == "reading":
        return f"reading {number} alone does not fit: measure it again"
    effect = CATALOGUE.get(moved.name) or CATALOGUE.get(kind)
    if effect is not None:
        return effect.moved.format(joint=number, size=_size(moved.estimates))
    return f"the instrument stands elsewhere, by {_size(moved.estimates)}: register it again"


def _size(estimates: Sequence[Estimate]) -> str:
    """Return how far lengths, angles and masses moved."""
    sizes = []
    for unit, (factor, unit_name) in FACTORS.items():
        own = [e for e in estimates if e.unit == unit]
        if not own:
            continue
        size = float(np.linalg.norm([e.value for e in own]))
        sure = float(np.sqrt(np.mean([e.std**2 for e in own])))
        if size > 2 * sure or len(estimates) == 1:
            sizes.append(f"{factor * size:.3g} {unit_name} (1 sigma {factor * sure:.2g})")
    return " and ".join(sizes) or "little"
