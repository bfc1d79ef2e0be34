"""Texts for the operator: joint angles, loads, lengths, durations, the result of a verification."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.bridge.document.numbers import unit_of
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import Payload
from gapbridge.core.calibration.result import Estimate
from gapbridge.core.calibration.verify import CandidateChange, Verification
from gapbridge.core.effects import CATALOGUE


def joints_text(q: Array) -> str:
    """Return joint angles (n,), rad, in degrees."""
    return "  ".join(f"J{i + 1} {v:+.2f}°" for i, v in enumerate(np.degrees(q)))


def millimetres(value: float) -> str:
    """Return a length (m) in mm; decimals by size."""
    size = abs(value) * 1e3
    if not np.isfinite(size):
        return "not known"
    return f"{value * 1e3:.{3 if size < 10 else 2 if size < 100 else 0}f} mm"


def reading_text(value: Array) -> str:
    """Return a reading (k,), SI units, in mm (and mrad); k = 0: contact alone."""
    if not len(value):
        return "seated"
    lengths = " ".join(f"{v * 1e3:.3f}" for v in value[:3])
    turns = " ".join(f"{v * 1e3:.3f}" for v in value[3:])
    return f"{lengths} mm" + (f", {turns} mrad" if turns else "")


def force_text(wrench: Array | None) -> str:
    """Return the force of a wrench (6,), N, Nm."""
    if wrench is None:
        return "nothing"
    return " ".join(f"{v:+.2f}" for v in wrench[:3]) + " N"


def load_text(load: Payload) -> str:
    """Return name, mass and centre of gravity of a load."""
    cog = ", ".join(f"{v * 1e3:g}" for v in load.cog)
    name = f"{load.name}: " if load.name else ""
    return f"{name}{load.mass:g} kg, centre of gravity ({cog}) mm from the flange"


def duration(seconds: float) -> str:
    """Return an estimated duration (s), rounded."""
    minutes = seconds / 60.0
    if minutes < 1.0:
        return "less than a minute"
    if minutes < 90.0:
        return f"about {minutes:.0f} min"
    return f"about {int(minutes // 60)} h {round(minutes % 60 / 5) * 5:02d} min"


def number_text(value: float) -> str:
    """Return a number with three decimals, from 10 on with one."""
    if not np.isfinite(value):
        return "not known"
    return f"{value:.3f}" if abs(value) < 10.0 else f"{value:.1f}"


def quantity_text(value: float, unit: str) -> str:
    """Return a value with its unit, m as mm, rad as mrad."""
    shown, factor = unit_of(unit)
    return f"{number_text(value * factor)} {shown}"


def verdict_text(verification: Verification) -> str:
    """Return the result of a verification in one sentence."""
    errors = verification.errors
    text = (
        f"{len(errors.rows)} poses are {1e3 * errors.rms:.3f} mm rms off, "
        f"{verification.ratio:.2f} times what the calibration predicted"
    )
    if verification.holds:
        return f"the calibration holds: {text}"
    change = (
        "no single change of tool, load, instrument or one joint explains it: recalibrate"
        if verification.moved is None
        else change_text(verification.moved)
    )
    return f"the calibration no longer holds: {text} (chance {verification.chance:.1g}); {change}"


def change_text(change: CandidateChange) -> str:
    """Return what has changed since the calibration, and by how much."""
    if change.reading is not None:
        return f"reading {change.reading} alone does not fit: measure it again"
    if change.effect:
        size = _size(change.estimates)
        return CATALOGUE[change.effect].verification_message.format(joint=change.joint, size=size)
    return f"the instrument has moved by {_size(change.estimates)}: register it again"


def _size(estimates: Sequence[Estimate]) -> str:
    """Return the norm of the lengths, angles and masses that are significant."""
    sizes = []
    for unit in ("m", "rad", "kg"):
        selected, (name, factor) = [e for e in estimates if e.unit == unit], unit_of(unit)
        if not selected:
            continue
        size = float(np.linalg.norm([e.value for e in selected]))
        std = float(np.sqrt(np.mean([e.std**2 for e in selected])))
        if size > 2 * std or len(estimates) == 1:
            sizes.append(f"{factor * size:.3g} {name} (1 sigma {factor * std:.2g})")
    return " and ".join(sizes) or "little"
