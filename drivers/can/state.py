"""A complete sample -> RobotState, or the reason why it cannot be believed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import Arm
from gapbridge.core.errors import InvalidStateError
from gapbridge.core.state import RobotState
from gapbridge.drivers.can.assembler import Sample
from gapbridge.drivers.can.profile import CanProfile
from gapbridge.drivers.robot_modes import modes_of
from gapbridge.drivers.state_check import LARGEST, JointCheck

Vector = NDArray[np.float64]


class StateBuilder:
    """Makes states; remembers the sample before, for plausibility and for velocities."""

    def __init__(self, profile: CanProfile, arm: Arm) -> None:
        self._profile = profile
        self._joints = JointCheck(arm)
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
        wrong, present = self._joints.outside(sample.position), {}
        for name, values in sample.others.items():
            beyond = np.abs(values) > LARGEST[name]
            if wrong is None and beyond.any():
                joint = int(np.argmax(beyond))
                wrong = f"{name} of joint {joint + 1}: found {values[joint]:g}"
            if np.isfinite(values).all():
                present[name] = values
        if wrong is None and before is not None:
            gap = sample.received - before.received
            wrong = self._joints.jumped(sample.position - before.position, gap)
        if wrong is not None:
            raise InvalidStateError(f"{self._profile.name}: {wrong}")
        return present

    def _differences(self, sample: Sample, before: Sample | None) -> Vector:
        """Return velocities (n,) from two positions, rad/s; the bus's clock where it moves."""
        if before is not None:
            gap = sample.stamp - before.stamp
            if not 1e-4 < gap < 1.0:
                gap = sample.received - before.received
            if gap > 1e-4:
                self._qd = (sample.position - before.position) / gap
        return self._qd
