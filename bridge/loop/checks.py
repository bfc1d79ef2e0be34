"""Checks of every cycle, except those of the link; each finding is reported once."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy import float64
from numpy.typing import NDArray

from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.loop_counters import LoopCounter
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop.link_monitor import hold_time
from gapbridge.bridge.loop.reports import Reports
from gapbridge.bridge.loop.supervisor import Cause, Supervisor
from gapbridge.core.arrays import Array
from gapbridge.core.state import ENVELOPE, JOINT_LIMIT, JOINT_OFFSET, RobotState
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.rate_check import RateCheck
from gapbridge.drivers.robot_modes import PLAYING, why_not_ready

MIN_SPEED_SCALING = 0.95  # below it, an arm that we move lags behind its setpoints
MAX_SPEED_SCALING = 2.0  # above it, the value is implausible
MAX_GAP_CYCLES = 10.0  # cycles: after a longer gap between states, filters restart
SETTINGS_EVERY = 1.0  # s between two checks of the controller's settings
REPORT_EVERY = 1.0  # s between two events of a finding that comes and goes, as of a loose cable
FROZEN_AFTER = 1.0  # s for which joints may stay bit-identical while they should move
COMMANDED_AWAY = 2e-3  # rad: they should move if the command has moved this far,
MOVING = 0.02  # rad/s: or if a joint reports this velocity
OVERRUN_SPAN = 1.0  # s over which missed cycles are counted
MAX_MISSED_SHARE = 0.05  # share of a span's cycles that may be missed
SATURATION_TIMEOUT = 1.0  # s that an offset may be at its limits
_AT_LIMIT = 1 << ENVELOPE | 1 << JOINT_OFFSET | 1 << JOINT_LIMIT
# bits of a cycle's flags
DEGRADED, LATE, RESYNC, RAMPING_OUT, UNSOLVED, NOTHING, TOOK_BACK = 1, 2, 4, 8, 16, 32, 64


class FrozenWatch:
    """Detects frozen joint values; an arm at rest under a constant command is not frozen.

    Nor is one that begins to move: velocity and command change before joints reported in counts.
    """

    def __init__(self) -> None:
        self._q: list[float] | None = None
        self._target: Array | None = None  # commanded when the joints were last seen to move
        self._since = 0.0  # s, controller clock: since when they should have moved

    def acknowledge(self) -> None:
        """Take the present command as that of an arm at rest: a person has looked at it.

        A single wrong command, or a motor that was off, would keep an arm at rest unarmed for ever.
        Joints that report a velocity are still frozen.
        """
        self._target = None

    def update(self, state: RobotState, commanded: Array) -> str | None:
        """Return a message if the values are frozen, else None."""
        q, now = state.actual_q, state.timestamp
        joints = q.tolist()
        if now < self._since or joints != self._q:
            self._q, self._target, self._since = joints, commanded.copy(), now
            return None
        if self._target is None:
            self._target = commanded.copy()
        away = float(np.abs(commanded - self._target).max())
        turning = float(np.abs(state.actual_qd).max())
        if away < COMMANDED_AWAY and turning < MOVING:
            self._since = now
        if now - self._since < FROZEN_AFTER:
            return None
        return (
            f"joints have been bit-identical for {now - self._since:.2f} s, while the command "
            f"moved {away:.4f} rad and the reported velocity is {turning:.3f} rad/s"
        )


class OverrunWatch:
    """Counts the cycles missed because the loop took too long, within a span."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._missed: deque[tuple[float, int]] = deque()  # s, cycles
        self._sum = 0

    def reset(self) -> None:
        """Restart: the loop read no states meanwhile."""
        self._missed.clear()
        self._sum = 0

    def update(self, now: float, missed: int) -> str | None:
        """Add the cycles missed before this one; returns a message if there are too many."""
        queue = self._missed
        while queue and now - queue[0][0] > OVERRUN_SPAN:
            self._sum -= queue.popleft()[1]
        if not missed:
            return None
        queue.append((now, missed))
        self._sum += missed
        if self._sum <= MAX_MISSED_SHARE * OVERRUN_SPAN * self._rate or len(queue) < 2:
            return None  # a single long cycle is checked by its gap
        cycles = OVERRUN_SPAN * self._rate
        detail = f"{self._sum} of {cycles:.0f} cycles missed within {OVERRUN_SPAN:g} s"
        self.reset()
        return detail


class SaturationWatch:
    """Detects an offset that stays at its limits."""

    def __init__(self) -> None:
        self._since: float | None = None

    def update(self, now: float, clamped: int) -> str | None:
        """Return a message if the offset has been at a limit for too long, else None."""
        if not clamped & _AT_LIMIT:
            self._since = None
            return None
        if self._since is None or now < self._since:
            self._since = now
        if now - self._since <= SATURATION_TIMEOUT:
            return None
        return f"the offset has been clamped at its limits for {now - self._since:.2f} s"


class LoopChecks:
    """The checks of one loop, and their active findings."""

    def __init__(
        self,
        rate: float,
        supervisor: Supervisor,
        reports: Reports,
        stale_after: float = 0.0,
        moves_arm: bool = False,
    ) -> None:
        self._supervisor, self._reports = supervisor, reports
        self._period = 1.0 / rate
        self._longest_gap = max(MAX_GAP_CYCLES / rate, hold_time(rate), stale_after)
        self._frozen, self._overrun = FrozenWatch(), OverrunWatch(rate)
        self.frozen: str | None = None  # why the joints' values are not trusted
        self._saturation = SaturationWatch()
        self._moves_arm, self._hold = moves_arm, hold_time(rate)
        self.rate = RateCheck(rate)
        self._not_following: float | None = None  # s, controller clock: since when
        self._settings_at = -1.0  # s, controller clock: of the next look
        self._active: set[LoopCounter] = set()
        self._shown: set[LoopCounter] = set()  # of the active ones, those that were reported
        self._emitted: dict[LoopCounter, float] = {}  # s, controller clock
        self._last: float | None = None  # s, controller clock
        self.not_ready = "no state has been read"  # why the robot cannot move; empty: it can

    def acknowledge(self) -> None:
        """Note that an arm that is not written to was looked at: a disarm, or a verification."""
        self._frozen.acknowledge()

    def reset(self) -> None:
        """Restart: the loop read no states meanwhile."""
        self._last = None
        self._overrun.reset()

    def begin(self, state: RobotState, missed: int) -> int:
        """Check a state before it is used; returns the cycle's flags.

        With RESYNC among them, filters must restart.
        """
        flags = (LATE if missed else 0) | (DEGRADED if state.sensor_lost else 0)
        if missed:
            self._reports.count(LoopCounter.LATE, missed)
        gap = 0.0 if self._last is None else state.timestamp - self._last
        self._last = state.timestamp
        resync = gap > self._longest_gap
        detail = f"found a gap of {gap:.3f} s between two states: restarted" if resync else None
        self._report(LoopCounter.RESYNC, detail, Cause.RESYNC)
        if resync:
            flags |= RESYNC
            self._overrun.reset()
        else:
            self._report(
                LoopCounter.OVERRUN, self._overrun.update(state.timestamp, missed), Cause.OVERRUN
            )
        self._report(LoopCounter.SENSOR_LOST, state.sensor_lost or None, None)
        self.rate.take(state.timestamp)
        self.not_ready = why_not_ready(state)
        self._report(LoopCounter.UNSAFE, self.not_ready or None, Cause.UNSAFE)
        self._check_following(state)
        return flags

    def check_loads(self, detail: str | None) -> None:
        """Hold if a payload or force is implausible (``detail``)."""
        self._report(LoopCounter.LOAD, detail, Cause.LOAD)

    def check_settings(self, state: RobotState, driver: Driver) -> None:
        """Compare the controller's own settings with the cell's, once a second while armed."""
        armed = self._supervisor.state in (State.ARMED, State.COMPENSATING, State.HOLDING)
        if not armed or 0.0 <= self._settings_at - state.timestamp <= SETTINGS_EVERY:
            return
        self._settings_at = state.timestamp + SETTINGS_EVERY
        self._report(LoopCounter.MISMATCH, driver.mismatch(), Cause.MISMATCH)

    def end(
        self, state: RobotState, commanded: NDArray[float64], clamped: int, duration: float
    ) -> None:
        """Check a cycle after its setpoint; ``commanded`` (n,) rad, ``duration`` s."""
        self.frozen = self._frozen.update(state, commanded)
        self._report(LoopCounter.FROZEN, self.frozen, Cause.FROZEN)
        self._report(
            LoopCounter.SATURATED,
            self._saturation.update(state.timestamp, clamped),
            Cause.SATURATED,
        )
        # computing time only: late or missing states are checked by the link monitor
        detail = self._overrun.update(state.timestamp, int(duration / self._period))
        self._report(LoopCounter.OVERRUN, detail, Cause.OVERRUN)

    def _check_following(self, state: RobotState) -> None:
        """Hold if the robot's program does not run, or runs slower than our setpoints."""
        scaling, detail = state.speed_scaling, None
        if state.runtime_state != PLAYING:
            detail = f"runtime_state: found {state.runtime_state}, expected {PLAYING} (playing)"
        elif not 0.0 <= scaling <= MAX_SPEED_SCALING:  # NaN is not
            detail = f"speed_scaling: found {scaling:g}, expected 0 to {MAX_SPEED_SCALING:g}"
        elif self._moves_arm and scaling < MIN_SPEED_SCALING:
            detail = (
                f"speed_scaling: found {scaling:g}, expected {MIN_SPEED_SCALING:g} or more: "
                "the arm would lag behind its setpoints"
            )
        if detail is None or not self._supervisor.state.writes:
            self._not_following = None
        elif self._not_following is None:
            self._not_following = state.timestamp
        since = self._not_following
        lasts = since is not None and state.timestamp - since > self._hold
        self._report(LoopCounter.NOT_FOLLOWING, detail if lasts else None, Cause.NOT_FOLLOWING)

    def _report(self, counter: LoopCounter, detail: str | None, cause: Cause | None) -> None:
        """Notify the supervisor of a finding (``detail``); count and emit it once."""
        if detail is None:
            self._active.discard(counter)
            if counter in self._shown and counter == LoopCounter.SENSOR_LOST:
                self._reports.emit(
                    {"kind": EventKind.DEGRADED, "what": "", "detail": "the sensor is back"}
                )
            self._shown.discard(counter)
            return
        faulty = self._supervisor.state == State.FAULT  # the first fault is what is latched
        changed = cause is not None and not faulty and self._supervisor.take(cause, detail)
        if counter not in self._active:
            self._active.add(counter)
            self._reports.count(counter)
        if counter in self._shown:
            return
        if changed or self._supervisor.state == State.FAULT:  # the transition reports it
            self._shown.add(counter)
        elif self._may_emit(counter):
            self._shown.add(counter)
            lost = counter == LoopCounter.SENSOR_LOST
            kind = EventKind.DEGRADED if lost else EventKind.WARNING
            self._reports.emit({"kind": kind, "what": counter.label, "detail": detail})

    def _may_emit(self, counter: LoopCounter) -> bool:
        """Return whether an event of a finding is due: events that fill their socket are lost."""
        now, last = self._last or 0.0, self._emitted.get(counter)
        if last is not None and 0.0 <= now - last < REPORT_EVERY:
            return False
        self._emitted[counter] = now
        return True
