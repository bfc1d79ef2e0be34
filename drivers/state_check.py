"""The plausibility check of a sample: one set of limits and one check, for all drivers."""

from __future__ import annotations

from math import isfinite
from operator import le

import numpy as np

from gapbridge.core.arm import Arm
from gapbridge.core.errors import Implausible, InvalidStateError
from gapbridge.core.load_bounds import WRENCH
from gapbridge.core.state import RobotState

FASTEST = 20.0  # rad/s, of a joint whose URDF gives no velocity limit
VELOCITY_FACTOR = 1.5  # times its velocity limit: a larger step of a joint is implausible
JITTER = 0.01  # rad: noise of one reading
LIMIT_MARGIN = 0.35  # rad past a joint limit: another arm, another zero, or other units
LARGEST_ANGLE = 1e4  # rad, of a joint without limits
TARGET = 20.0  # rad: bound of target_q, unless the joint's own limits are wider
LARGEST: dict[str, float] = {
    "actual_qd": 60.0, "joint_temperatures": 300.0, "actual_current_as_torque": 1e4,
    "payload_cog": 10.0,
}  # fmt: skip
"""Largest plausible magnitudes of the other vectors of a RobotState, SI units."""
HEAVIEST = 1e3  # kg, of a payload
LATEST = 1e11  # s, of a clock: 3000 years


class SampleCheck:
    """Checks each sample by itself and against the last plausible one.

    It uses lists of floats: for some dozens of numbers they are faster than arrays.
    """

    def __init__(self, arm: Arm, fastest: float = FASTEST) -> None:
        limits, speed = arm.limits, arm.limits.velocity
        lower = np.maximum(limits.lower - LIMIT_MARGIN, -LARGEST_ANGLE)
        upper = np.minimum(limits.upper + LIMIT_MARGIN, LARGEST_ANGLE)
        fast = np.minimum(VELOCITY_FACTOR * np.where(np.isfinite(speed), speed, FASTEST), fastest)
        self._fastest: list[float] = fast.tolist()
        self._bounds: dict[str, tuple[list[float], list[float]]] = {
            "actual_q": (lower.tolist(), upper.tolist()),
            "target_q": (np.minimum(lower, -TARGET).tolist(), np.maximum(upper, TARGET).tolist()),
            "actual_TCP_force": ([-v for v in WRENCH], [*WRENCH]),
            "ft_raw_wrench": ([-v for v in WRENCH], [*WRENCH]),
        }
        for name, most in LARGEST.items():
            count = 3 if name == "payload_cog" else arm.n
            self._bounds[name] = ([-most] * count, [most] * count)
        self._others = [name for name in self._bounds if name != "actual_q"]
        self._q: list[float] | None = None
        self._timestamp = 0.0

    def reset(self) -> None:
        """Accept the next sample without comparing it with the previous one."""
        self._q = None

    def check(self, state: RobotState) -> None:
        """Store a plausible sample. Raises InvalidStateError for an implausible one."""
        if not abs(state.timestamp) <= LATEST:  # NaN is not; cycles are counted by it
            raise InvalidStateError(
                f"timestamp: found {state.timestamp:g} s, expected at most {LATEST:g}",
                Implausible.VALUE if isfinite(state.timestamp) else Implausible.NOT_FINITE,
            )
        q = state.actual_q.tolist()
        self._check_bounds("actual_q", q)
        self._check_motion(q, state.timestamp)  # first: a velocity may be computed from the step
        for name in self._others:
            value = getattr(state, name)
            if value is None or (name == "actual_TCP_force" and _force_is_missing(state)):
                continue
            self._check_bounds(name, value.tolist())
        payload = state.payload
        if payload is not None and not 0.0 <= payload <= HEAVIEST:
            raise InvalidStateError(
                f"payload: found {payload:g} kg, expected 0 to {HEAVIEST:g}", Implausible.VALUE
            )
        self._q, self._timestamp = q, state.timestamp

    def _check_bounds(self, name: str, values: list[float]) -> None:
        low, high = self._bounds[name]
        if all(map(le, low, values)) and all(map(le, values, high)):  # NaN is neither
            return
        i = next(i for i, v in enumerate(values) if not low[i] <= v <= high[i])
        if not isfinite(values[i]):
            raise InvalidStateError(
                f"{name}_{i}: found {values[i]:g}, expected a finite number",
                Implausible.NOT_FINITE,
            )
        detail = f"{name}_{i}: found {values[i]:g}, expected {low[i]:g} to {high[i]:g}"
        if name == "actual_q":
            detail += ": another arm, another zero, or other units"
        raise InvalidStateError(detail, Implausible.VALUE)

    def _check_motion(self, q: list[float], timestamp: float) -> None:
        if self._q is None:
            return
        gap = timestamp - self._timestamp
        if gap <= 0.0:
            raise InvalidStateError(
                f"the controller's clock went back by {-gap:.4f} s", Implausible.BACKWARDS
            )
        for i, (now, before, fast) in enumerate(zip(q, self._q, self._fastest, strict=True)):
            most = fast * gap + JITTER
            if abs(now - before) > most:
                raise InvalidStateError(
                    f"actual_q_{i}: found a step of {abs(now - before):.4f} rad in {gap:.4f} s, "
                    f"expected at most {most:.4f}",
                    Implausible.STEP,
                )


def _force_is_missing(state: RobotState) -> bool:
    """Return whether there is no force because its sensor is lost."""
    return bool(state.sensor_lost) and not isfinite(sum(state.actual_TCP_force.tolist()))
