"""A complete sample -> RobotState, or the reason why it cannot be believed."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from core.arm import Arm
from core.errors import InvalidStateError
from core.state import RobotState
from drivers.can.profile import CanProfile
from drivers.can.sample import Sample

Vector = NDArray[np.float64]
FASTEST = 20.0  # rad/s: joints that move faster between two samples are a mistake
JITTER = 0.01  # rad
LARGEST_ANGLE = 1e4  # rad
BEYOND = 0.35  # rad past a joint limit: another arm, or another zero
LARGEST = {"velocity": 60.0, "torque": 1e4, "temperature": 300.0}
RUNNING, IDLE = 7, 5  # RTDE robot_mode
SAFETY = {
    "": (1, 1), "not_ready": (1, 1), "protective_stop": (3, 1 << 2), "emergency_stop": (7, 1 << 7),
    "fault": (9, 1 << 9),
}  # fmt: skip
"""Trouble -> RTDE safety_mode and safety_status_bits."""


class StateBuilder:
    """Makes states; remembers the sample before, for plausibility and for velocities."""

    def __init__(self, profile: CanProfile, arm: Arm) -> None:
        self._profile = profile
        self._lower: list[float] = (arm.limits.lower - BEYOND).tolist()
        self._upper: list[float] = (arm.limits.upper + BEYOND).tolist()
        self._before: Sample | None = None
        self._qd = np.zeros(profile.n)

    def forget(self) -> None:
        """Take the next sample without comparing it."""
        self._before = None

    def build(self, sample: Sample, target: Vector | None, trouble: str, ready: bool) -> RobotState:
        """Return the state of a sample. Raises InvalidStateError.

        ``target`` (n,) is what the arm was last told, where anyone told it.
        """
        q = sample.position
        before = self._before
        self._check(q, sample.others)
        if before is not None:  # a refused sample does not replace it: the next is compared too
            self._check_step(q - before.position, sample.received - before.received)
        qd = _told(sample.others.get("velocity"))
        if qd is None:
            qd = self._differences(sample, before)
        self._before = sample
        safety, bits = SAFETY[trouble]
        temperature, torque = sample.others.get("temperature"), sample.others.get("torque")
        return RobotState(
            timestamp=sample.received,
            received=sample.received,
            actual_q=q,
            actual_qd=qd,
            target_q=q if target is None else target,
            actual_TCP_force=np.zeros(6),
            joint_temperatures=_told(temperature),
            actual_current_as_torque=_told(torque),
            robot_mode=IDLE if trouble == "not_ready" or not ready else RUNNING,
            safety_mode=safety,
            safety_status_bits=bits,
        )

    def _check(self, q: Vector, others: dict[str, Vector]) -> None:
        """Refuse what no such arm can say; plain numbers, since arrays of six cost more."""
        for i, angle in enumerate(q.tolist()):
            if not -LARGEST_ANGLE <= angle <= LARGEST_ANGLE:  # NaN is not either
                raise self._invalid(f"joint {i + 1}: found {angle:g}, expected a finite angle")
            if not self._lower[i] <= angle <= self._upper[i]:
                raise self._invalid(
                    f"joint {i + 1}: found {angle:.4f} rad, far outside the arm's limits: another "
                    "arm, or another zero"
                )
        for name, most in LARGEST.items():
            for i, value in enumerate(others[name].tolist() if name in others else ()):
                if abs(value) > most:
                    raise self._invalid(f"{name} of joint {i + 1}: found {value:g}")

    def _check_step(self, step: Vector, gap: float) -> None:
        most = FASTEST * gap + JITTER
        for i, way in enumerate(step.tolist()):
            if abs(way) > most:
                raise self._invalid(
                    f"joint {i + 1}: found a step of {abs(way):.4f} rad in {gap:.4f} s"
                )

    def _differences(self, sample: Sample, before: Sample | None) -> Vector:
        """Return velocities (n,) from two positions, rad/s; the bus's clock where it moves."""
        if before is not None:
            gap = sample.stamp - before.stamp
            if not 1e-4 < gap < 1.0:
                gap = sample.received - before.received
            if gap > 1e-4:
                self._qd = (sample.position - before.position) / gap
        return self._qd

    def _invalid(self, words: str) -> InvalidStateError:
        return InvalidStateError(f"{self._profile.name}: {words}")


def _told(value: Vector | None) -> Vector | None:
    """Return a quantity that every joint has told, else None."""
    if value is None or not all(map(math.isfinite, value.tolist())):
        return None
    return value
