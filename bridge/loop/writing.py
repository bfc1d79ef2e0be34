"""The writing half of the loop: start, send, bring to rest, release."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.loop_counters import LoopCounter
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import Phase
from gapbridge.bridge.loop.link_monitor import hold_time
from gapbridge.bridge.loop.offset_in_force import OffsetInForce
from gapbridge.bridge.loop.reports import Reports
from gapbridge.bridge.loop.setpoint_stream import SetpointStream
from gapbridge.bridge.loop.supervisor import Cause, Supervisor
from gapbridge.bridge.setpoint_source.source import Source, SourceDryError
from gapbridge.core.arrays import Array
from gapbridge.core.errors import (
    ForeignCommandError,
    GateError,
    IneffectiveWriteError,
    LateSetpointError,
    LimitError,
    PartialWriteError,
    RobotBusyError,
    StaleStateError,
    WriteError,
)
from gapbridge.core.loads import Loads
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.driver import Driver

SETTLED, SETTLING_TIMEOUT = 2e-6, 0.3  # rad from the last setpoint, s until release anyway
PARTIAL_WRITE_LIMIT = 3  # setpoints in a row sent only in part that end the motion


class Writing:
    """Sends setpoints in the states of the supervisor that allow it."""

    def __init__(
        self,
        settings: SetpointSettings,
        driver: Driver,
        source: Source,
        stream: SetpointStream,
        supervisor: Supervisor,
        reports: Reports,
        in_force: OffsetInForce | None = None,
    ) -> None:
        self._settings, self._driver, self._source = settings, driver, source
        self._now, self._hold = driver.clock.monotonic, hold_time(driver.rate)
        self._stream, self._supervisor, self._reports = stream, supervisor, reports
        self._in_force = in_force or OffsetInForce(driver.n, None)
        self.ready = False  # the driver is armed
        self._ready_since = 0.0  # s, monotonic
        self.has_armed = False  # the driver has been armed in this process
        self.unsent: Setpoint | None = None  # computed in the last cycle, not (completely) sent
        self.ramps_out = False  # the last setpoint's offset was ramping out
        self.took_back = False  # the setpoint before the last one is not in force
        self._refused = False  # the last setpoint computed was not sent, and never will be
        self.lost: str | None = None  # why the link is lost
        self._paused = False  # see ``take_paused``
        self._failed = 0  # setpoints in a row sent only in part
        self._settling = 0.0  # s, monotonic: since when the setpoint is at rest

    def take_paused(self) -> bool:
        """Return, once, whether arming or releasing kept the loop from reading states."""
        paused, self._paused = self._paused, False
        return paused

    @property
    def transit_time(self) -> float:
        """Return the bound of the last sample's transit time, s; see Driver.transit_time."""
        return self._driver.transit_time() if self.ready else 0.0

    def start(self, state: RobotState, nominal_q: Array) -> bool:
        """Start writing once the source has a first setpoint and the driver is ready.

        Returns whether a fresh state is needed, because it took too long.
        """
        first = self._source.first(nominal_q)
        if first is None:
            if self.ready:
                self._await_first()
            return False
        away = np.abs(first - nominal_q)
        tolerance = self._settings.start_tolerance
        if not (away <= tolerance).all():
            joint = int(np.argmax(away))
            self._refuse_start(
                f"joint {joint + 1}: found the first setpoint {away[joint]:.4f} rad from the arm, "
                f"expected at most {tolerance:g} (setpoints.start_tolerance)"
            )
            return False
        try:
            if not self.ready:
                self._arm_driver(state)
                return True
            in_force = self._in_force.offset_at(nominal_q) if self._driver.moves_arm else None
            start_q = self._stream.start(nominal_q, state.timestamp, in_force=in_force)
        except (WriteError, LimitError) as error:
            if isinstance(error, ForeignCommandError):
                self._reports.count(LoopCounter.FOREIGN)
            self._refuse_start(str(error))
            return True
        self._source.begin(state.timestamp, start_q)
        self._failed, self._refused, self._settling = 0, False, 0.0
        self._supervisor.take(Cause.WRITING)
        return False

    def _await_first(self) -> None:
        """Keep the driver armed until the source's timeout: what came before is not taken."""
        if self._now() - self._ready_since > self._settings.timeout:
            self._refuse_start("the source fell silent before the first setpoint")
            return
        try:
            self._driver.keep_alive()
        except WriteError as error:
            self._refuse_start(str(error))

    def _arm_driver(self, state: RobotState) -> None:
        """Arm the driver; a fresh state is needed afterwards. Raises WriteError."""
        self._reports.memory.enter(Phase.ARMING)
        self.has_armed = True
        try:
            self._check_round_trip()
            for warning in self._driver.arm(state):
                detail = str(warning)
                self._reports.emit({"kind": EventKind.WARNING, "what": "cell", "detail": detail})
            self.ready, self._ready_since = True, self._now()
        finally:
            self._reports.memory.enter(Phase.RUNNING)
            self._paused = True

    def _check_round_trip(self) -> None:
        """Raise WriteError if the round trip is too long for fresh states."""
        round_trip, rate = self._driver.round_trip(), self._driver.rate
        most = hold_time(rate) - 1.0 / rate  # a setpoint is sent within a cycle
        if round_trip is not None and round_trip > most:
            raise WriteError(
                f"link: a question and its answer take {1e3 * round_trip:.0f} ms, expected at most "
                f"{1e3 * most:.0f} ms: no state behind a setpoint may be older"
            )

    def _refuse_start(self, detail: str) -> None:
        self.release()
        self._supervisor.take(Cause.START_REFUSED, detail)

    def write(
        self, state: RobotState, nominal_q: Array, loads: Loads, expiry: float = np.inf
    ) -> Setpoint | None:
        """Send one setpoint; returns it, or None if none was sent.

        ``expiry`` (s, monotonic): after it no setpoint from this state may be sent.
        """
        stream, self.unsent, self.took_back = self._stream, None, False
        self.ramps_out = self._supervisor.state == State.HOLDING
        if self._now() > expiry:
            stream.reset_solver()
            return None
        source_q = self._next_setpoint(state, nominal_q)
        self.ramps_out = self._supervisor.state == State.HOLDING
        goal = 0.0 if self.ramps_out else 1.0
        try:
            self._driver.keep_alive()  # may block: before the state's age is checked
            expiry = min(expiry, self._driver.unanswered_since() + self._hold)
            self._take_back()
            setpoint = stream.advance(state, source_q, loads, goal, expiry)
        except StaleStateError:
            stream.reset_solver()
            self._reports.count(LoopCounter.LATE)
            return None
        except WriteError as error:
            stream.reset_solver()
            self._on_write_error(error)
            return None
        except LimitError as error:
            stream.reset_solver()
            self._end_motion(LoopCounter.SETPOINT_REFUSED, Cause.SETPOINT_REFUSED, str(error))
            return None
        try:
            if not stream.finite:
                self._refuse(setpoint)
                detail = "the model's correction is no number"
                self._end_motion(LoopCounter.BAD_OUTPUT, Cause.BAD_OUTPUT, detail)
            elif self._now() > expiry:  # the system suspended this process since the check
                self._refuse(setpoint)
                self._reports.count(LoopCounter.LATE)
            else:
                self._driver.write_setpoint(setpoint, expiry)
                self._in_force.note(setpoint.q, stream.joint_offset, setpoint.offset_in_base)
                self._failed = 0
                self._check_solved()
                self._check_late(expiry)
                return setpoint
        except RobotBusyError as error:  # not in force; the newest one leaves when it is free
            self.unsent = _copied(setpoint)
            if isinstance(error, LateSetpointError):
                self._reports.count(LoopCounter.LATE)
        except GateError as error:
            self._refuse(setpoint)
            self._on_write_error(error)
        except WriteError as error:
            self.unsent = _copied(setpoint)
            self._on_write_error(error)
        return None

    def _refuse(self, setpoint: Setpoint) -> None:
        """Note a setpoint of which nothing was sent."""
        self.unsent, self._refused = _copied(setpoint), True

    def _take_back(self) -> None:
        """Go on from what is in force where the last setpoint is not."""
        lapsed = self._driver.take_lapsed()
        if lapsed:
            self._in_force.take_back()
        if lapsed or self._refused:
            self._stream.take_back()
            self.took_back, self._refused = True, False

    def _check_solved(self) -> None:
        """End the motion if the model has no correction; the offset ramps out."""
        detail = self._stream.unsolved
        if detail and self._supervisor.take(Cause.UNSOLVED, detail):
            self._reports.count(LoopCounter.UNSOLVED)

    def _check_late(self, expiry: float) -> None:
        """End the motion if the system suspended this process between check and sending."""
        late = self._now() - expiry
        if late > 0.0:
            detail = f"a setpoint left {1e3 * late:.0f} ms after its state was too old"
            self._reports.count(LoopCounter.OVERRUN)
            self._supervisor.take(Cause.OVERRUN, detail)

    def _on_write_error(self, error: WriteError) -> None:
        """Act on a setpoint that could not be delivered."""
        if isinstance(error, GateError):
            self._end_motion(LoopCounter.SETPOINT_REFUSED, Cause.SETPOINT_REFUSED, str(error))
        elif isinstance(error, PartialWriteError):
            self._on_partial_write(str(error))
        elif isinstance(error, IneffectiveWriteError):
            self._end_motion(LoopCounter.WRITE_INEFFECTIVE, Cause.INEFFECTIVE, str(error))
        elif isinstance(error, ForeignCommandError):
            self._end_motion(LoopCounter.FOREIGN, Cause.FOREIGN, str(error))
        else:
            self._reports.count(LoopCounter.WRITE_FAILED)
            self._supervisor.take(Cause.WRITE_FAILED, str(error))
            self.ready = False
            self.lost = str(error)

    def _on_partial_write(self, detail: str) -> None:
        """Leave it to the next cycle's setpoint; after PARTIAL_WRITE_LIMIT, end the motion."""
        self._reports.count(LoopCounter.WRITE_PARTIAL)
        self._failed += 1
        if self._failed >= PARTIAL_WRITE_LIMIT:
            self._failed = 0
            self._end_motion(LoopCounter.WRITE_INEFFECTIVE, Cause.INEFFECTIVE, detail)

    def _end_motion(self, what: LoopCounter, cause: Cause, detail: str) -> None:
        """End the motion as the transition table says; release if no more may be written."""
        self._reports.count(what)
        self._supervisor.take(cause, detail)
        if not self._supervisor.state.writes:
            self.release()

    def at_rest(self, setpoint: Setpoint, state: RobotState) -> bool:
        """Return whether the offset is zero and, if setpoints move the arm, the arm is at rest.

        The controller's target lags: an early release would stop the arm short of the setpoint.
        """
        if not self._driver.moves_arm:
            return self._stream.has_no_offset
        if not self._stream.at_rest:
            return False
        now = self._now()
        self._settling = self._settling or now
        near = bool((np.abs(state.target_q - setpoint.q) < SETTLED).all())
        if near or now - self._settling > SETTLING_TIMEOUT:
            self._settling = 0.0
            return True
        return False

    def _next_setpoint(self, state: RobotState, nominal_q: Array) -> Array | None:
        """Return the source's setpoint (n,) rad; None: the motion must brake."""
        if self._supervisor.state == State.HOLDING:
            return None if self._driver.moves_arm else nominal_q
        try:
            source_q = self._source.sample(state.timestamp, nominal_q)
        except SourceDryError as error:
            self._reports.count(LoopCounter.SOURCE_DRY)
            self._supervisor.take(Cause.SOURCE_DRY, str(error))
            return None if self._driver.moves_arm else nominal_q
        if self._source.ended and self._stream.arrived and not self._reports.memory.ended:
            self._reports.memory.note_ended()
            detail = "the source has come to its end; the arm stays there"
            self._reports.emit({"kind": EventKind.SOURCE, "what": "ended", "detail": detail})
        return source_q

    def release(self) -> None:
        """Release the driver; the arm is at rest, or has stopped because of a fault."""
        self._stream.end()
        self._settling = 0.0  # of a motion that ended before the arm had settled
        if not self.ready:
            return
        self.ready = False
        self._reports.memory.enter(Phase.ARMING)
        try:
            if self._supervisor.state == State.FAULT:
                self._driver.abandon()
            else:
                self._driver.release()
        except WriteError as error:
            self._reports.emit({"kind": EventKind.LINK, "what": "release", "detail": str(error)})
        self._reports.memory.enter(Phase.RUNNING)
        self._paused = True


def _copied(setpoint: Setpoint) -> Setpoint:
    """Return a setpoint with copies of its arrays, which the limiter reuses."""
    return setpoint._replace(
        q=setpoint.q.copy(),
        nominal_q=setpoint.nominal_q.copy(),
        offset_in_base=setpoint.offset_in_base.copy(),
    )
