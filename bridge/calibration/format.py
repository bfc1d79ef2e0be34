"""How poses, loads, lengths and times are worded for a technician."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import Payload


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


SHOWN_IN = {"m": ("mm", 1e3), "rad": ("mrad", 1e3), "rad/Nm": ("µrad/Nm", 1e6)}


def figure(value: float) -> str:
    """Return a number with three or four digits that count."""
    if not np.isfinite(value):
        return "not known"
    return f"{value:.3f}" if abs(value) < 10.0 else f"{value:.1f}"


def parameter(value: float, unit: str) -> str:
    """Return a value as it is reported, m as mm, rad as mrad."""
    shown, factor = SHOWN_IN.get(unit, (unit, 1.0))
    return f"{figure(value * factor)} {shown}"
