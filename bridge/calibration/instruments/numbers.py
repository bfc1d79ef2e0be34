"""Numbers as people and tracker software write them, turned into SI."""

from __future__ import annotations

import math
import re

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import ReadingError
from gapbridge.bridge.cell.settings.instruments import METRES, RADIANS, Coordinates
from gapbridge.core.arrays import Array
from gapbridge.core.rotation import rotation_vector, rpy_matrix

FARTHEST = 100.0  # m: no instrument of this kind looks farther
_NAME = re.compile(r"[A-Za-z_][A-Za-z_0-9]*\s*[:=]")  # "X = 12.3": what stands before a number
_UNIT = re.compile(r"(?<=[\d.,\s])(mm|um|µm|m|in|deg|rad|°)(?=[\s,;]|$)")


def numbers(text: str, count: int, unit: str = "") -> list[float]:
    """Return exactly ``count`` finite numbers of a line.

    Between them stand commas, semicolons, tabs or spaces; a decimal comma is understood where
    something else stands between them. A unit that is written out must be ``unit``. Raises
    ReadingError.
    """
    plain = _NAME.sub(" ", text.strip())
    for written in _UNIT.findall(plain):
        reported = {"µm": "um", "°": "deg"}.get(written, written)
        if unit and reported != unit and reported not in RADIANS:
            raise ReadingError(f"found {written}, expected {unit}: the unit declared for it")
    plain = _UNIT.sub(" ", plain)
    message = _tokens(plain, count)
    found = []
    for word in message:
        try:
            found.append(float(word))
        except ValueError:
            raise ReadingError(f"found {word!r}, expected a number") from None
    if len(found) != count:
        plural = "s" if len(found) != 1 else ""
        raise ReadingError(f"found {len(found)} number{plural} in {text!r}, expected {count}")
    if not all(map(math.isfinite, found)):
        raise ReadingError(f"found {text!r}, expected finite numbers")
    return found


def _tokens(text: str, count: int) -> list[str]:
    for separator in (r";", r"\t+", r"\s+(?!$)"):
        parts = [p.strip() for p in re.split(separator, text.strip()) if p.strip()]
        if len(parts) == count and all(p.count(",") <= 1 for p in parts):
            stripped = [p[:-1] if p.endswith(",") else p for p in parts]
            return [p.replace(",", ".") if "." not in p else p for p in stripped]
    return [p for p in re.split(r"[\s,;]+", text.strip()) if p]


def coordinates(values: list[float], settings: Coordinates) -> Array:
    """Return a point (3,) in m, or a pose (6,) in m and rotation vector, in SI.

    Raises ReadingError where a length is beyond what such an instrument sees, or a quaternion has
    no unit length.
    """
    point = np.array(values[:3]) * METRES[settings.unit]
    if np.abs(point).max() > FARTHEST:
        at = int(np.abs(point).argmax())
        raise ReadingError(
            f"found {values[at]:g} {settings.unit}, {abs(point[at]):.0f} m away, expected at most "
            f"{FARTHEST:g} m: is the unit right?"
        )
    if not settings.pose:
        return point
    return np.concatenate([point, _turn(np.array(values[3:]), settings)])


def _turn(values: Array, settings: Coordinates) -> Array:
    if settings.rotation == "quaternion":
        length = float(np.linalg.norm(values))
        if abs(length - 1.0) > 1e-2:
            raise ReadingError(f"found a quaternion of length {length:.3g}, expected 1 (x y z w)")
        x, y, z, w = values / length
        half = np.array([x, y, z])
        sine = float(np.linalg.norm(half))
        if sine < 1e-12:
            return 2.0 * half
        return half / sine * 2.0 * math.atan2(sine, w)
    angles = values * RADIANS[settings.angle_unit]
    if np.abs(angles).max() > 2.0 * math.pi + 1e-6:
        raise ReadingError(
            f"found a rotation of {values[int(np.abs(angles).argmax())]:g} {settings.angle_unit}, "
            "expected at most a whole turn: is the unit right?"
        )
    if settings.rotation == "rpy":
        return np.asarray(rotation_vector(rpy_matrix(angles)))
    return angles
