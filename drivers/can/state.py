"""A complete sample -> RobotState, or the reason why it cannot be believed."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gapbridge.core.arm import Arm
from gapbridge.core.errors import InvalidStateError
from gapbridge.core.kernels.reference import JIT
from gapbridge.core.state import RobotState
from gapbridge.drivers.can.assembler import Sample
from gapbridge.drivers.can.codec import ORDER
from gapbridge.drivers.can.profile import CanProfile
from gapbridge.drivers.robot_modes import modes_of
from gapbridge.drivers.state_check import FASTEST, JITTER, LARGEST, JointCheck

Vector = NDArray[np.float64]


@njit(**JIT)
def _looked_at(table, bounds, before, step):  # type: ignore[no-untyped-def]
    """Return which rows (bits) of a sample every joint has reported; -1: it cannot be believed.

    ``table`` (q, n): position first; ``bounds`` (q + 1, n): least and most position, then the
    largest magnitude of each other row. ``before`` (n,): positions that are at most ``step`` rad
    away; negative: not compared.
    """
    present = 0
    for i in range(table.shape[1]):
        angle = table[0, i]
        if not (bounds[0, i] <= angle <= bounds[1, i]):  # NaN is not either
            return -1
        if abs(angle - before[i]) > step:
            return -1
    for k in range(1, table.shape[0]):
        whole = True
        for i in range(table.shape[1]):
            if abs(table[k, i]) > bounds[k + 1, i]:
                return -1
            whole = whole and np.isfinite(table[k, i])
        if whole:
            present |= 1 << k
    return present


class StateBuilder:
    """Makes states; remembers the sample before, for plausibility and for velocities."""

    def __init__(self, profile: CanProfile, arm: Arm) -> None:
        self._profile = profile
        self._joints = JointCheck(arm)
        self._names = [name for name in ORDER if name in profile.quantities]
        others = [np.full(profile.n, LARGEST[name]) for name in self._names[1:]]
        lower = self._joints.lower
        self._bounds = np.array([lower, self._joints.upper, *others])
        # compiled here: the first sample must not wait for a compiler
        _looked_at(np.zeros((len(self._names), profile.n)), self._bounds, lower, np.inf)
        self._before: Sample | None = None
        self._qd = np.zeros(profile.n)

    def forget(self) -> None:
        """Take the next sample without comparing it."""
        self._before = None

    def build(self, sample: Sample, target: Vector | None, trouble: str, ready: bool) -> RobotState:
        """Return the state of a sample. Raises InvalidStateError.

        ``target`` (n,) is what the arm was last commanded, where anyone commanded it.
        """
        q = sample.position
        before = self._before  # a refused sample does not replace it: the next is compared too
        present = self._values(sample, before)
        qd = present.get("velocity")
        if qd is None:
            qd = self._differences(sample, before)
        self._before = sample
        modes = modes_of((trouble, "" if ready else "not_ready"))
        return RobotState(
            timestamp=sample.received,
            received=sample.received,
            actual_q=q,
            actual_qd=qd,
            target_q=q if target is None else target,
            actual_TCP_force=np.zeros(6),
            joint_temperatures=present.get("temperature"),
            actual_current_as_torque=present.get("torque"),
            robot_mode=modes.robot_mode,
            safety_mode=modes.safety_mode,
            safety_status_bits=modes.safety_status_bits,
        )

    def _values(self, sample: Sample, before: Sample | None) -> dict[str, Vector]:
        """Return the quantities that every joint has reported. Raises InvalidStateError."""
        table, step, earlier = sample.table, np.inf, sample.position
        if before is not None:
            step = FASTEST * (sample.received - before.received) + JITTER
            earlier = before.position
        present = _looked_at(table, self._bounds, earlier, step)
        if present < 0:
            raise self._invalid(self._reason(sample, before))
        return {name: table[k] for k, name in enumerate(self._names) if present >> k & 1}

    def _reason(self, sample: Sample, before: Sample | None) -> str:
        """Return why a sample cannot be believed."""
        found = self._joints.outside(sample.position)
        if found is None:
            for name, values in sample.others.items():
                for i, value in enumerate(values.tolist()):
                    if abs(value) > LARGEST[name]:
                        return f"{name} of joint {i + 1}: found {value:g}"
        if found is None and before is not None:
            gap = sample.received - before.received
            found = self._joints.jumped(sample.position - before.position, gap)
        return found or "found a sample that cannot be believed"

    def _differences(self, sample: Sample, before: Sample | None) -> Vector:
        """Return velocities (n,) from two positions, rad/s; the bus's clock where it moves."""
        if before is not None:
            gap = sample.stamp - before.stamp
            if not 1e-4 < gap < 1.0:
                gap = sample.received - before.received
            if gap > 1e-4:
                self._qd = (sample.position - before.position) / gap
        return self._qd

    def _invalid(self, message: str) -> InvalidStateError:
        return InvalidStateError(f"{self._profile.name}: {message}")
