"""Whether a state can be believed: finite, plausible, and where the arm can have come to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.ipc.counts import Count
from gapbridge.core.arm import Arm
from gapbridge.core.state import RobotState
from gapbridge.drivers.state_check import FASTEST, LARGEST, JointCheck

Vector = NDArray[np.float64]
HASTE = 1.5  # times its velocity limit: a joint that moved faster is a mistake
_WRENCH = np.array([LARGEST["force"]] * 3 + [LARGEST["moment"]] * 3)


@dataclass(frozen=True, slots=True)
class Doubt:
    """Why a sample was not believed."""

    count: Count
    words: str


class SampleCheck:
    """Checks each sample against the last one that was believed."""

    def __init__(self, arm: Arm) -> None:
        speed = arm.limits.velocity
        self._joints = JointCheck(arm, HASTE * np.where(np.isfinite(speed), speed, FASTEST))
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
        outside = self._joints.outside(q)
        if outside is not None:
            return Doubt(Count.DROPPED_IMPLAUSIBLE, outside)
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
            jumped = self._joints.jumped(state.actual_q - before, gap)
            if jumped is not None:
                return Doubt(Count.DROPPED_STEP, jumped)
        self._q, self._timestamp = state.actual_q, state.timestamp
        return None
