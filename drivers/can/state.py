"""A complete sample -> RobotState."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.state import RobotState
from gapbridge.drivers.can.assembler import Sample
from gapbridge.drivers.robot_modes import StopReason, modes_of


class StateBuilder:
    """Makes states; keeps the previous sample, for velocities."""

    def __init__(self, n: int) -> None:
        self._before: Sample | None = None
        self._last: Sample | None = None  # of the state last made
        self._qd = np.zeros(n)

    def reset(self) -> None:
        """Compute no velocity from the next sample and those before."""
        self._before = None

    def remember(self) -> None:
        """Use the last state for velocities: it passed the plausibility check."""
        self._before = self._last

    def build(
        self, sample: Sample, target: Array | None, reason: StopReason | None, ready: bool
    ) -> RobotState:
        """Return the state of a sample.

        ``target`` (n,) rad: the joints commanded last, None if there are none.
        """
        q = sample.position
        present = {name: v for name, v in sample.others.items() if np.isfinite(v).all()}
        qd = present.get("velocity")
        if qd is None:
            qd = self._differences(sample, self._before)
        self._last = sample
        modes = modes_of((reason, None if ready else StopReason.NOT_READY))
        return RobotState(
            timestamp=sample.received,
            received=sample.received,
            actual_q=q,
            actual_qd=qd,
            target_q=q if target is None else target,
            actual_TCP_force=np.zeros(6),
            joint_temperatures=present.get("temperature"),
            actual_current_as_torque=present.get("torque"),
            **modes._asdict(),
        )

    def _differences(self, sample: Sample, before: Sample | None) -> Array:
        """Return velocities (n,) from two positions, rad/s; the bus's clock where it moves."""
        if before is not None:
            gap = sample.stamp - before.stamp
            if not 1e-4 < gap < 1.0:
                gap = sample.received - before.received
            if gap > 1e-4:
                self._qd = (sample.position - before.position) / gap
        return self._qd
