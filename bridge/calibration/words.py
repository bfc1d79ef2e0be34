"""How poses, loads, lengths and times are told to a technician."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.calibration.plan import Payload

Array = NDArray[np.float64]


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
        return f"{minutes:.0f} min"
    return f"{int(minutes // 60)} h {round(minutes % 60 / 5) * 5:02d} min"


def parameter(name: str, value: float, unit: str) -> str:
    """Return a value as it is told, m as mm, rad as mrad."""
    scaled = {"m": ("mm", 1e3), "rad": ("mrad", 1e3), "rad/Nm": ("1e-6 rad/Nm", 1e6)}
    shown, factor = scaled.get(unit, (unit, 1.0))
    return f"{value * factor:.4g} {shown}"
