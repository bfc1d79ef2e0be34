"""How poses, loads, lengths, times and a verification are worded for a technician."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.bridge.report.labels import unit_of
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import Payload
from gapbridge.core.calibration.result import Estimate
from gapbridge.core.calibration.verify import CandidateChange, Verification
from gapbridge.core.effects import CATALOGUE


def degrees(q: Array) -> str:
    """Return joints as a pendant shows them."""
    return "  ".join(f"J{i + 1} {v:+.2f}°" for i, v in enumerate(np.degrees(q)))


def millimetres(value: float) -> str:
    """Return a length in mm, as many digits as count."""
    size = abs(value) * 1e3
    if not np.isfinite(size):
        return "not known"
    return f"{value * 1e3:.{3 if size < 10 else 2 if size < 100 else 0}f} mm"


def point(value: Array) -> str:
    """Return a reading (k,) in mm (and mrad)."""
    if not len(value):
        return "seated"
    lengths = " ".join(f"{v * 1e3:.3f}" for v in value[:3])
    turns = " ".join(f"{v * 1e3:.3f}" for v in value[3:])
    return f"{lengths} mm" + (f", {turns} mrad" if turns else "")


def force(wrench: Array | None) -> str:
    """Return a flange sensor's reading (6,): its force in N."""
    if wrench is None:
        return "nothing"
    return " ".join(f"{v:+.2f}" for v in wrench[:3]) + " N"


def load_text(load: Payload) -> str:
    """Return a load: name, mass, centre of gravity."""
    cog = ", ".join(f"{v * 1e3:g}" for v in load.cog)
    name = f"{load.name}: " if load.name else ""
    return f"{name}{load.mass:g} kg, centre of gravity ({cog}) mm from the flange"


def duration(seconds: float) -> str:
    """Return a time to go, as coarse as it is known."""
    minutes = seconds / 60.0
    if minutes < 1.0:
        return "less than a minute"
    if minutes < 90.0:
        return f"about {minutes:.0f} min"
    return f"about {int(minutes // 60)} h {round(minutes % 60 / 5) * 5:02d} min"


def figure(value: float) -> str:
    """Return a number with three or four digits that count."""
    if not np.isfinite(value):
        return "not known"
    return f"{value:.3f}" if abs(value) < 10.0 else f"{value:.1f}"


def parameter(value: float, unit: str) -> str:
    """Return a value as it is reported, m as mm, rad as mrad."""
    shown, factor = unit_of(unit)
    return f"{figure(value * factor)} {shown}"


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
        "no single change of tool, load, instrument or one joint explains it: recalibrate"
        if found.moved is None
        else moved_text(found.moved)
    )
    return f"the calibration no longer holds: {text} (chance {found.chance:.1g}); {moved}"


def moved_text(moved: CandidateChange) -> str:
    """Return what moved, and by how much."""
    if moved.reading is not None:
        return f"reading {moved.reading} alone does not fit: measure it again"
    if moved.effect:
        size = _size(moved.estimates)
        return CATALOGUE[moved.effect].moved.format(joint=moved.joint, size=size)
    return f"the instrument stands elsewhere, by {_size(moved.estimates)}: register it again"


def _size(estimates: Sequence[Estimate]) -> str:
    """Return how far lengths, angles and masses moved."""
    sizes = []
    for unit in ("m", "rad", "kg"):
        own, (name, factor) = [e for e in estimates if e.unit == unit], unit_of(unit)
        if not own:
            continue
        size = float(np.linalg.norm([e.value for e in own]))
        sure = float(np.sqrt(np.mean([e.std**2 for e in own])))
        if size > 2 * sure or len(estimates) == 1:
            sizes.append(f"{factor * size:.3g} {name} (1 sigma {factor * sure:.2g})")
    return " and ".join(sizes) or "little"
