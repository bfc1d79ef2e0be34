"""Numbers for reports: lengths in mm, angles in mrad, digits by their uncertainty."""

from __future__ import annotations

import math

from gapbridge.bridge.document.axes import plain
from gapbridge.bridge.report.labels import decimals_of, fixed, unit_of
from gapbridge.core.calibration.result import Estimate


def mm(length: float) -> str:
    """Return a length (m) in mm, to 1 µm; below 10 µm to 0.1 µm, from 10 mm on to 10 µm."""
    if not math.isfinite(length):
        return "unknown"
    size = abs(length) * 1e3
    decimals = 4 if 0 < size < 0.00995 else 3 if size < 10 else 2
    return f"{fixed(length * 1e3, decimals)} mm"


def mm_fine(length: float) -> str:
    """Return a length (m) in mm to 0.1 µm, for terms of a sum."""
    return f"{fixed(length * 1e3, 4)} mm" if math.isfinite(length) else "unknown"


def load_title(mass: float, name: str = "") -> str:
    """Return "8 kg" or "1 kg (gripper)"; a name equal to the mass is omitted."""
    weight = f"{plain(mass)} kg"
    return f"{weight} ({name})" if name and name != weight else weight


def mrad(angle: float) -> str:
    """Return an angle (rad) in mrad."""
    return f"{fixed(angle * 1e3, 3)} mrad" if math.isfinite(angle) else "unknown"


def estimate_texts(e: Estimate) -> tuple[str, str, str, str]:
    """Return value, 95 % interval, 1 sigma and unit of an estimate, rounded by its sigma."""
    unit, factor = unit_of(e.unit)
    digits = decimals_of(e.std * factor)
    low, high = (fixed(v * factor, digits) for v in e.interval)
    return fixed(e.value * factor, digits), f"{low} to {high}", fixed(e.std * factor, digits), unit


def degrees(q: object) -> str:
    """Return joint angles (n,), rad, in degrees with one decimal."""
    return ", ".join(fixed(math.degrees(float(v)), 1) for v in q)  # type: ignore[attr-defined]
