"""The first readings of a place, before they show where the instrument stands.

They are held to the instrument's and the arm's reach, and to each other: two positions are as far
apart as the joints put them, two distances differ by no more than that, two balls on one tool keep
their distance. Generous, since nothing is calibrated yet: wrong units and exchanged stops are seen.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.readings import Readings

NEAREST = 0.02  # m: nothing on a tool comes nearer to an instrument's origin, or to a second ball
FARTHEST = 100.0  # m: no instrument of this kind looks farther
WIDEST = 3.0  # m between two balls on one tool
LOOSE, SHARE = 0.05, 0.1  # m, and share of a distance, by which an uncalibrated arm may be off
BALLS, BALLS_SHARE = 1e-3, 0.01  # the same for two balls, which no arm moves against each other


def early_check(before: Readings, new: Readings, tip: Array) -> tuple[float, float, str] | None:
    """Return how far a reading is off (m), how far it may be, and why it is doubted; None: not.

    ``new`` is one reading, ``tip`` (N + 1, 3) m where the cell's model has the TCP at those
    ``before`` and then at the new one, base.
    """
    value = new.value[0, :3]
    if not len(value):
        return None
    checks: dict[str, Callable[[], tuple[float, float, str] | None]] = {
        "position": lambda: _points(before, value, tip),
        "pose": lambda: _points(before, value, tip),
        "distance": lambda: _distances(before, float(value[0]), tip),
        "relative": lambda: _balls(before, value),
    }
    check = checks.get(new.kind)
    return check() if check else None


def _points(before: Readings, value: Array, tip: Array) -> tuple[float, float, str] | None:
    far = float(np.linalg.norm(value))
    if not NEAREST <= far <= FARTHEST:
        return _off(far, NEAREST if far < NEAREST else FARTHEST, "from the instrument's origin")
    for i, earlier in enumerate(before.value[:, :3]):
        apart = float(np.linalg.norm(value - earlier))
        meant = float(np.linalg.norm(tip[-1] - tip[i]))
        allowed = LOOSE + SHARE * meant
        if abs(apart - meant) > allowed:
            reason = (
                f"it is {1e3 * apart:.1f} mm from an earlier reading here; the joints put the two "
                f"{1e3 * meant:.0f} mm apart"
            )
            return abs(apart - meant), allowed, reason
    return None


def _distances(before: Readings, value: float, tip: Array) -> tuple[float, float, str] | None:
    if abs(value) > FARTHEST:
        return _off(abs(value), FARTHEST, "from the fixed end")
    for i, earlier in enumerate(before.value[:, 0]):
        meant = float(np.linalg.norm(tip[-1] - tip[i]))
        change, allowed = abs(value - float(earlier)), meant + LOOSE + SHARE * meant
        if change > allowed:
            reason = (
                f"it differs by {1e3 * change:.1f} mm from an earlier reading; the joints put the "
                f"two {1e3 * meant:.0f} mm apart"
            )
            return change, allowed, reason
    return None


def _balls(before: Readings, value: Array) -> tuple[float, float, str] | None:
    far = float(np.linalg.norm(value))
    if not NEAREST <= far <= WIDEST:
        return _off(far, NEAREST if far < NEAREST else WIDEST, "between the balls")
    for earlier in before.value:
        apart = float(np.linalg.norm(earlier))
        allowed = BALLS + BALLS_SHARE * apart
        if abs(far - apart) > allowed:
            reason = f"the balls are {1e3 * far:.1f} mm apart, {1e3 * apart:.1f} mm before"
            return abs(far - apart), allowed, reason
    return None


def _off(far: float, limit: float, where: str) -> tuple[float, float, str]:
    side = "at least" if far < limit else "at most"
    reason = f"{1e3 * far:.3f} mm {where}, expected {side} {1e3 * limit:.0f} mm"
    return abs(far - limit), 0.0, reason
