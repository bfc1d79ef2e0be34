"""Numbers as reports and the terminal show them: display units, digits by size or uncertainty."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gapbridge.core.calibration.result import Estimate

DIGITS = 4  # significant, of a number
WRITTEN_OUT = (1e6, 1e12)  # smaller numbers have no exponent: with DIGITS, and with more digits
UNITS: dict[str, tuple[str, float]] = {
    "m": ("mm", 1e3),
    "rad": ("mrad", 1e3),
    "s": ("ms", 1e3),
    "rad/Nm": ("µrad/Nm", 1e6),
    "1/K": ("ppm/K", 1e6),
    "1/(N m2)": ("1/(MN m²)", 1e6),
    "1/(Nm)2": ("1/(kNm)²", 1e6),
    "N/s": ("N/h", 3600.0),
    "Nm/s": ("Nm/h", 3600.0),
    "kg m2": ("kg m²", 1.0),
    "Nm s/rad": ("Nm s/rad", 1.0),
    "": ("%", 1e2),
}


def unit_of(unit: str) -> tuple[str, float]:
    """Return the display unit for an SI unit, and the factor from SI."""
    return UNITS.get(unit, (unit, 1.0))


def fixed(value: float, decimals: int) -> str:
    """Return a number with ``decimals`` decimals and a typographic minus, without "-0"."""
    if not math.isfinite(value):
        return "unknown"
    text = f"{value:.{decimals}f}"
    if not text.strip("-0."):
        text = text.lstrip("-")
    return text.replace("-", "−")


def decimals_of(spread: float) -> int:
    """Return the number of decimals that shows two significant digits of a spread."""
    if not math.isfinite(spread) or spread <= 0:
        return 3
    return min(max(1 - math.floor(math.log10(spread)), 0), 9)


def number(value: float, digits: int = 3) -> str:
    """Return a number with ``digits`` significant digits, with an exponent only if extreme."""
    if not math.isfinite(value):
        return "unknown"
    if value == 0:
        return "0"
    size = math.floor(math.log10(abs(value)))
    if size < -4 or size > 6:
        return f"{value:.{digits - 1}e}"
    text = f"{value:.{max(digits - 1 - size, 0)}f}"
    return text.replace("-", "−")


def with_unit(value: float | None, unit: str) -> str:
    """Return a value (SI) in its display unit; "unknown" for None."""
    if value is None:
        return "unknown"
    name, factor = unit_of(unit)
    return f"{number(value * factor)} {name}"


def percent(share: float | None) -> str:
    """Return a share (0 to 1) as percent."""
    if share is None or not math.isfinite(share):
        return "unknown"
    return f"{round(share * 100)} %".replace("-", "−")


def likelihood(probability: float) -> str:
    """Return a probability as percent, bounded at 0.1 and 99.9 %."""
    if not math.isfinite(probability):
        return "unknown"
    if probability > 0.999:
        return "over 99.9 %"
    if probability < 0.001:
        return "under 0.1 %"
    return f"{probability * 100:.1f} %"


def plain(value: float, digits: int = DIGITS) -> str:
    """Return a number without trailing zeros and without leading zeros in its exponent."""
    text = f"{value:.{digits}g}"
    if "e+" in text and abs(value) < WRITTEN_OUT[digits > DIGITS]:
        text = f"{float(text):.0f}"
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa}{e}{int(exponent) if e else ''}".replace("-", "−")


def mm(length: float) -> str:
    """Return a length (m) in mm, to 1 µm; below 10 µm to 0.1 µm, from 10 mm on to 10 µm."""
    size = abs(length) * 1e3
    return _fixed_in("mm", length, 4 if 0 < size < 0.00995 else 3 if size < 10 else 2)


def mm_fine(length: float) -> str:
    """Return a length (m) in mm to 0.1 µm, for terms of a sum."""
    return _fixed_in("mm", length, 4)


def mrad(angle: float) -> str:
    """Return an angle (rad) in mrad."""
    return _fixed_in("mrad", angle, 3)


def _fixed_in(unit: str, value: float, decimals: int) -> str:
    return f"{fixed(value * 1e3, decimals)} {unit}" if math.isfinite(value) else "unknown"


def load_title(mass: float, name: str = "") -> str:
    """Return "8 kg" or "1 kg (gripper)"; a name equal to the mass is omitted."""
    weight = f"{plain(mass)} kg"
    return f"{weight} ({name})" if name and name != weight else weight


def estimate_texts(e: Estimate) -> tuple[str, str, str, str]:
    """Return value, 95 % interval, 1 sigma and unit of an estimate, rounded by its sigma."""
    unit, factor = unit_of(e.unit)
    digits = decimals_of(e.std * factor)
    low, high = (fixed(v * factor, digits) for v in e.interval)
    return fixed(e.value * factor, digits), f"{low} to {high}", fixed(e.std * factor, digits), unit


def degrees(q: object) -> str:
    """Return joint angles (n,), rad, in degrees with one decimal."""
    return ", ".join(fixed(math.degrees(float(v)), 1) for v in q)  # type: ignore[attr-defined]
