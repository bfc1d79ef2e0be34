"""One SYNC's TPDOs -> RobotState."""

from __future__ import annotations

from collections import deque

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.state import RobotState
from gapbridge.drivers.canopen.objects import FAULTS, MODE_ACTIVE, State, state_of
from gapbridge.drivers.canopen.profile import CanopenProfile
from gapbridge.drivers.canopen.sync_set import SyncSet
from gapbridge.drivers.robot_modes import StopReason, modes_of

SPAN, OLDEST = 5, 0.1  # samples, s: for a velocity, if drives report none


def states(sample: SyncSet) -> list[State]:
    """Return the drives' states, per joint."""
    return [state_of(counts["Statusword"]) for counts in sample.counts]


def positions(profile: CanopenProfile, sample: SyncSet) -> Array:
    """Return the joint angles (n,), rad."""
    return profile.angles(np.array([c["Position actual value"] for c in sample.counts], float))


def not_following(profile: CanopenProfile, sample: SyncSet) -> int | None:
    """Return a joint (from 0) whose drive does not act on setpoints; None: all do."""
    for joint, (counts, state) in enumerate(zip(sample.counts, states(sample), strict=True)):
        mode = counts.get("Modes of operation display", profile.mode_number)
        active = counts["Statusword"] & MODE_ACTIVE or not profile.file.confirms_mode
        if state != "OPERATION ENABLED" or mode != profile.mode_number or not active:
            return joint
    return None


class StateBuilder:
    """Makes states; keeps the previous samples, for velocities."""

    def __init__(self, profile: CanopenProfile, clears_faults: bool = False) -> None:
        self._profile, self._clears_faults = profile, clears_faults
        self._rated = profile.rated_torque
        self._last: deque[tuple[float, Array]] = deque(maxlen=SPAN)  # s of the SYNC, rad

    @property
    def last_q(self) -> Array | None:
        """Return the joints (n,) of the sample before, rad."""
        return self._last[-1][1] if self._last else None

    def reset(self) -> None:
        """Compute no velocity from the next sample and those before."""
        self._last.clear()

    def remember(self, state: RobotState) -> None:
        """Store a state that passed the plausibility check."""
        self._last.append((state.timestamp, state.actual_q))

    def build(self, sample: SyncSet, target: Array | None, armed: bool) -> RobotState:
        """Return the state.

        ``target`` (n,): joints commanded last, rad. The time of the sample is that
        of its SYNC, at which all drives latched their positions.
        """
        q = positions(self._profile, sample)
        modes = modes_of([self._stop_reason(sample, armed)])
        return RobotState(
            timestamp=sample.synced,
            received=sample.received,
            actual_q=q,
            actual_qd=self._velocity(sample, q),
            target_q=q if target is None else target,
            actual_TCP_force=np.zeros(6),
            actual_current_as_torque=self._torque(sample),
            **modes._asdict(),
        )

    def _stop_reason(self, sample: SyncSet, armed: bool) -> StopReason | None:
        reported = states(sample)
        if any(state in FAULTS for state in reported) and (armed or not self._clears_faults):
            return StopReason.FAULT  # else arming resets it, as it leads out of every other state
        if not armed:
            return None
        if "QUICK STOP ACTIVE" in reported:
            return StopReason.PROTECTIVE_STOP
        following = not_following(self._profile, sample) is None
        return None if following else StopReason.NOT_READY

    def _velocity(self, sample: SyncSet, q: Array) -> Array:
        """Return (n,) rad/s: from the drives, if the profile has the unit.

        Otherwise from the last samples: a single step would contain the SYNC's jitter.
        """
        scale = self._profile.file.velocity_scale
        reported = [counts.get("Velocity actual value") for counts in sample.counts]
        if scale is not None and None not in reported:
            return np.array(reported, float) * scale / self._profile.counts_per_radian
        while self._last and sample.synced - self._last[0][0] > OLDEST:
            self._last.popleft()
        if not self._last:
            return np.zeros(self._profile.n)
        synced, before = self._last[0]
        return np.asarray((q - before) / max(sample.synced - synced, 1e-4))

    def _torque(self, sample: SyncSet) -> Array | None:
        """Return (n,) Nm: Torque actual value is in thousandths of the rated torque."""
        if self._rated is None:
            return None
        reported = np.array([counts["Torque actual value"] for counts in sample.counts], float)
        return reported * 1e-3 * self._rated * self._profile.direction
