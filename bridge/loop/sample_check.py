"""Whether a state can be believed: finite, plausible, and where the arm can have come to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bridge.ipc.counts import Count
from core.arm import Arm
from core.state import RobotState

Vector = NDArray[np.float64]
BEYOND = 0.35  # rad: a joint may be this far outside its limits, read with its own zero
FASTEST = 20.0  # rad/s, of joints whose limit is not known
HASTE = 1.5  # times its velocity limit: a joint that moved faster is a mistake
JITTER = 0.01  # rad: of one reading
FORCE, TORQUE = 1.0e4, 1.0e4  # N, Nm: no arm of this size bears it
_WRENCH = np.array([FORCE] * 3 + [TORQUE] * 3)


@dataclass(frozen=True, slots=True)
class Doubt:
    """Why a sample was not believed."""

    count: Count
    words: str


class SampleCheck:
    """Checks each sample against the last one that was believed."""

    def __init__(self, arm: Arm) -> None:
        limits = arm.limits
        self._lower, self._upper = limits.lower - BEYOND, limits.upper + BEYOND
        self._speed = HASTE * np.where(np.isfinite(limits.velocity), limits.velocity, FASTEST)
        self._q: Vector | None = None
        self._timestamp = 0.0

    def forget(self) -> None:
        """Take the next sample without comparing it to the ones before."""
        self._q = None

    def doubt(self, state: RobotState) -> Doubt | None:
        """Return why a sample cannot be believed; None: it can, and is remembered."""
        q = state.actual_q
        force = state.actual_TCP_force
        sound = bool(np.isfinite(q).all() and np.isfinite(state.target_q).all())
        sound = sound and bool(np.isfinite(state.actual_qd).all())
        if not sound or not (state.sensor_lost or np.isfinite(force).all()):
            return Doubt(Count.DROPPED_NOT_FINITE, "found a number that is not finite in the state")
        if (q < self._lower).any() or (q > self._upper).any():
            joint = int(np.argmax((q < self._lower) | (q > self._upper)))
            return Doubt(
                Count.DROPPED_IMPLAUSIBLE,
                f"joint {joint + 1}: found {q[joint]:.4f} rad, far outside the arm's limits",
            )
        if (np.abs(force) > _WRENCH).any():
            return Doubt(Count.DROPPED_IMPLAUSIBLE, f"found a force of {np.abs(force).max():.3g}")
        return self._doubt_motion(state)

    def _doubt_motion(self, state: RobotState) -> Doubt | None:
        before, gap = self._q, state.timestamp - self._timestamp
        if before is not None:
            if gap <= 0.0:
                return Doubt(
                    Count.DROPPED_BACKWARDS,
                    f"the controller's clock went back by {-gap:.4f} s",
                )
            way = np.abs(state.actual_q - before)
            if (way > self._speed * gap + JITTER).any():
                joint = int(np.argmax(way - self._speed * gap))
                return Doubt(
                    Count.DROPPED_STEP,
                    f"joint {joint + 1}: found a step of {way[joint]:.4f} rad in {gap:.4f} s",
                )
        self._q, self._timestamp = state.actual_q, state.timestamp
        return None
