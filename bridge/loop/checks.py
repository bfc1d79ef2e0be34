"""What is looked at in every cycle beside the link itself; each finding is reported once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy import float64
from numpy.typing import NDArray

from gapbridge.bridge.ipc.counts import Count
from gapbridge.bridge.ipc.shared_memory import Page
from gapbridge.bridge.loop.frozen_watch import FrozenWatch
from gapbridge.bridge.loop.link_monitor import hold_time
from gapbridge.bridge.loop.overrun_watch import OverrunWatch
from gapbridge.bridge.loop.readiness import RateCheck
from gapbridge.bridge.loop.saturation_watch import SaturationWatch
from gapbridge.bridge.loop.supervisor import Cause, State, Supervisor
from gapbridge.core.state import RobotState
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.robot_modes import NORMAL, REDUCED, RUNNING

SAFE = (NORMAL, REDUCED)  # safety_mode
STOPS = 0b111_1111_1100  # safety_status_bits: all but normal and reduced mode
PLAYING = 2  # runtime_state
SLOWED = 0.95  # speed_scaling: slower, an arm that we move falls behind its setpoints
FASTEST = 2.0  # speed_scaling: more is a mistake
LONG_GAP = 10.0  # cycles: after a longer one, what was before means nothing
SETTINGS_EVERY = 1.0  # s between two looks at how the controller is set
# bits of a cycle's flags
DEGRADED, LATE, RESYNC, RAMPING_OUT, UNSOLVED, NOTHING = 1, 2, 4, 8, 16, 32


class LoopChecks:
    """The checks of one loop, and what they have found that still lasts."""

    def __init__(
        self,
        rate: float,
        supervisor: Supervisor,
        page: Page,
        tell: Callable[[dict[str, Any]], None],
        stale_after: float = 0.0,
        moves_arm: bool = False,
    ) -> None:
        self._supervisor, self._page, self._tell = supervisor, page, tell
        self._period = 1.0 / rate
        self._longest_gap = max(LONG_GAP / rate, hold_time(rate), stale_after)
        self._frozen, self._overrun = FrozenWatch(), OverrunWatch(rate)
        self._saturation = SaturationWatch()
        self._moves_arm, self._patience = moves_arm, hold_time(rate)
        self.rate = RateCheck(rate)
        self._not_following: float | None = None  # s, controller clock: since when
        self._settings_at = -1.0  # s, controller clock: of the next look
        self._lasting: set[Count] = set()
        self._last: float | None = None  # s, controller clock
        self.fine = False  # the robot can move
        self.robot = ""  # what is wrong with it
        self.flags = 0  # of this cycle

    def forget(self) -> None:
        """Begin anew: the loop did something else meanwhile."""
        self._last = None
        self._overrun.forget()

    def begin(self, state: RobotState, missed: int) -> bool:
        """Check a state before it is used; returns whether what was before means nothing now."""
        self.flags = (LATE if missed else 0) | (DEGRADED if state.sensor_lost else 0)
        if missed:
            self._page.count(Count.LATE, missed)
        gap = 0.0 if self._last is None else state.timestamp - self._last
        self._last = state.timestamp
        resync = gap > self._longest_gap
        words = f"found a gap of {gap:.3f} s between two states: begun anew" if resync else None
        self._judge(Count.RESYNC, words, Cause.RESYNC)
        if resync:
            self.flags |= RESYNC
            self._overrun.forget()
        else:
            self._judge(Count.OVERRUN, self._overrun.update(state.timestamp, missed), Cause.OVERRUN)
        self._judge(Count.SENSOR_LOST, state.sensor_lost or None, None)
        self.rate.take(state.timestamp)
        self._check_robot(state)
        self._check_following(state)
        return resync

    def judge_loads(self, words: str | None) -> None:
        """Hold where a payload or a force is none that the arm can bear."""
        self._judge(Count.LOAD, words, Cause.LOAD)

    def judge_settings(self, state: RobotState, driver: Driver) -> None:
        """Compare the controller's own settings with the cell's, once a second while armed."""
        armed = self._supervisor.state in (State.ARMED, State.COMPENSATING, State.HOLDING)
        if not armed or 0.0 <= self._settings_at - state.timestamp <= SETTINGS_EVERY:
            return
        self._settings_at = state.timestamp + SETTINGS_EVERY
        self._judge(Count.MISMATCH, driver.mismatch(), Cause.MISMATCH)

    def end(
        self, state: RobotState, commanded: NDArray[float64], clamped: int, duration: float
    ) -> None:
        """Check a cycle after its setpoint; ``commanded`` (n,) rad, ``duration`` s."""
        self._judge(Count.FROZEN, self._frozen.update(state, commanded), Cause.FROZEN)
        self._judge(
            Count.SATURATED, self._saturation.update(state.timestamp, clamped), Cause.SATURATED
        )
        # its own work only: what a controller sends late or never is the link's affair
        words = self._overrun.update(state.timestamp, int(duration / self._period))
        self._judge(Count.OVERRUN, words, Cause.OVERRUN)

    def _check_robot(self, state: RobotState) -> None:
        """Take note of a robot that cannot move."""
        stops = state.safety_status_bits & STOPS
        self.fine = state.robot_mode == RUNNING and state.safety_mode in SAFE and not stops
        if self.fine:
            self.robot = ""
            self._lasting.discard(Count.UNSAFE)
            return
        self.robot = f"robot_mode {state.robot_mode}, safety_mode {state.safety_mode}"
        if stops:
            self.robot += f", safety_status_bits {state.safety_status_bits:#b}"
        self._judge(Count.UNSAFE, self.robot, Cause.UNSAFE)

    def _check_following(self, state: RobotState) -> None:
        """Hold where the robot's program does not play, or plays slower than we move the arm."""
        scaling, words = state.speed_scaling, None
        if state.runtime_state != PLAYING:
            words = f"runtime_state: found {state.runtime_state}, expected {PLAYING} (playing)"
        elif not 0.0 <= scaling <= FASTEST:  # NaN is not
            words = f"speed_scaling: found {scaling:g}, expected 0 to {FASTEST:g}"
        elif self._moves_arm and scaling < SLOWED:
            words = (
                f"speed_scaling: found {scaling:g}, expected {SLOWED:g} or more: it falls behind"
            )
        if words is None or not self._supervisor.state.writes:
            self._not_following = None
        elif self._not_following is None:
            self._not_following = state.timestamp
        since = self._not_following
        lasts = since is not None and state.timestamp - since > self._patience
        self._judge(Count.NOT_FOLLOWING, words if lasts else None, Cause.NOT_FOLLOWING)

    def _judge(self, what: Count, words: str | None, cause: Cause | None) -> None:
        """Notify the supervisor of a finding; count and report it once for as long as it lasts."""
        if words is None:
            if what in self._lasting:
                self._lasting.discard(what)
                if what == Count.SENSOR_LOST:
                    self._tell({"kind": "degraded", "what": "", "detail": "the sensor is back"})
            return
        changed = cause is not None and self._supervisor.take(cause, words)
        if what in self._lasting:
            return
        self._lasting.add(what)
        self._page.count(what)
        if not changed and self._supervisor.state != State.FAULT:
            kind = "degraded" if what == Count.SENSOR_LOST else "warning"
            self._tell({"kind": kind, "what": what.label, "detail": words})
