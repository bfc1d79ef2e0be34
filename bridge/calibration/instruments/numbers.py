"""Parses numbers as operators and tracker software write them, and converts them to SI units."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import ReadingError
from gapbridge.bridge.cell.settings.instruments import METRES, RADIANS, Coordinates
from gapbridge.core.arrays import Array
from gapbridge.core.rotation import rotation_vector, rpy_matrix

MAX_RANGE = 100.0  # m, of an instrument
_NAME = re.compile(r"[A-Za-z_][A-Za-z_0-9]*\s*[:=]")  # the label in "X = 12.3"
_UNITS = r"(mm|cm|um|µm|μm|m|inch(?:es)?|in|\"|ft|deg|rad|°)"
_UNIT = re.compile(rf"(?<=[\d.,\s]){_UNITS}(?=[\s,;]|$)", re.IGNORECASE)
_HEADER_UNIT = re.compile(rf"[\[(]\s*{_UNITS}\s*[\])]")  # as in "X [mm]"
_SPELLINGS = {"µm": "um", "μm": "um", "inch": "in", "inches": "in", '"': "in", "°": "deg"}


def parse_numbers(text: str, count: int, *units: str) -> list[float]:
    """Return exactly ``count`` finite numbers of a line.

    Separators are commas, semicolons, tabs or spaces; decimal commas are accepted with any other
    separator. A unit in the text must be one of ``units``. Raises ReadingError.
    """
    plain = _NAME.sub(" ", text.strip())
    for written in _UNIT.findall(plain):
        _require_declared(written, units)
    plain = _UNIT.sub(" ", plain)
    values = []
    for token in _tokens(plain, count):
        try:
            values.append(float(token.replace("_", "x")))  # Python reads 1_0 as 10
        except ValueError:
            raise ReadingError(f"found {token!r}, expected a number") from None
    if len(values) != count:
        plural = "s" if len(values) != 1 else ""
        raise ReadingError(f"found {len(values)} number{plural} in {text!r}, expected {count}")
    if not all(map(math.isfinite, values)):
        raise ReadingError(f"found {text!r}, expected finite numbers")
    return values


def _require_declared(written: str, units: Sequence[str]) -> None:
    """Raise ReadingError for a unit that is not one of ``units``; none: any is accepted."""
    standard = _SPELLINGS.get(written.lower(), written.lower())
    if units and standard not in units:
        same = [unit for unit in units if (unit in RADIANS) == (standard in RADIANS)]
        raise ReadingError(
            f"found {written}, expected {(*same, *units)[0]}: the unit declared for it"
        )


def check_header(name: str, units: Sequence[str]) -> None:
    """Raise ReadingError where a column's name has in brackets another unit than ``units``."""
    for written in _HEADER_UNIT.findall(name):
        _require_declared(written, units)


def _tokens(text: str, count: int) -> list[str]:
    for separator in (r";", r"\t+", r"\s+(?!$)"):
        parts = [p.strip() for p in re.split(separator, text.strip()) if p.strip()]
        if len(parts) == count and all(p.count(",") <= 1 for p in parts):
            stripped = [p[:-1] if p.endswith(",") else p for p in parts]
            return [p.replace(",", ".") if "." not in p else p for p in stripped]
    return [p for p in re.split(r"[\s,;]+", text.strip()) if p]


def to_si(values: list[float], settings: Coordinates) -> Array:
    """Return a position (3,) in m, or a pose (6,): position in m, rotation vector in rad.

    Raises ReadingError if a coordinate exceeds MAX_RANGE, an angle one turn, or if a quaternion
    has no unit length.
    """
    point = np.array(values[:3]) * METRES[settings.unit]
    if np.abs(point).max() > MAX_RANGE:
        i = int(np.abs(point).argmax())
        raise ReadingError(
            f"found {values[i]:g} {settings.unit}, {abs(point[i]):.0f} m away, expected at most "
            f"{MAX_RANGE:g} m: is the unit right?"
        )
    if not settings.pose:
        return point
    return np.concatenate([point, _rotation_vector(np.array(values[3:]), settings)])


def _rotation_vector(values: Array, settings: Coordinates) -> Array:
    if settings.rotation == "quaternion":
        length = float(np.linalg.norm(values))
        if abs(length - 1.0) > 1e-2:
            raise ReadingError(f"found a quaternion of length {length:.3g}, expected 1 (x y z w)")
        x, y, z, w = values / length
        vector = np.array([x, y, z])
        sine = float(np.linalg.norm(vector))  # of half the angle
        if sine < 1e-12:
            return 2.0 * vector
        return vector / sine * 2.0 * math.atan2(sine, w)
    angles = values * RADIANS[settings.angle_unit]
    if np.abs(angles).max() > 2.0 * math.pi + 1e-6:
        raise ReadingError(
            f"found a rotation of {values[int(np.abs(angles).argmax())]:g} {settings.angle_unit}, "
            "expected at most a whole turn: is the unit right?"
        )
    if settings.rotation == "rpy":
        return np.asarray(rotation_vector(rpy_matrix(angles)))
    return angles
