"""The control loop: read a state, check it, compensate, limit, write. It owns the link.

Every setpoint is computed from a fresh, valid state; starting never moves the arm; silence of the
controller is a fault. The states of the loop and their transitions are in supervisor.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.ipc.command_memory import Command, Commands
from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.loop_counters import LoopCounter
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import Phase, SharedMemory, write_cycle
from gapbridge.bridge.loop.checks import (
    NOTHING,
    RAMPING_OUT,
    RESYNC,
    TOOK_BACK,
    UNSOLVED,
    LoopChecks,
)
from gapbridge.bridge.loop.link_monitor import ControllerClock, LinkMonitor, hold_time
from gapbridge.bridge.loop.live_loads import LiveLoads
from gapbridge.bridge.loop.offset_in_force import OffsetInForce
from gapbridge.bridge.loop.reports import Reports
from gapbridge.bridge.loop.setpoint_stream import SetpointStream, longest_ramp_out
from gapbridge.bridge.loop.supervisor import Cause, Supervisor
from gapbridge.bridge.loop.writing import Writing
from gapbridge.bridge.setpoint_source.source import Source, SourceStatus
from gapbridge.core.arrays import Array
from gapbridge.core.compensation import Compensator
from gapbridge.core.errors import InvalidStateError, LinkError
from gapbridge.core.load_bounds import LoadBounds
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.robot_modes import why_not_ready

STOP_TIMEOUT = 1.0  # s from a stop request to the release, plus the ramp at the cell's rates
STOP_RAMP_TIME = 0.5  # s: longest ramp when stopping
DAEMON_SILENT = 5.0  # s without a heartbeat of the daemon, after which nobody could disarm

UNSENT = 2  # "attempted" of a cycle whose setpoint was computed and not (completely) sent

Emit = Callable[[dict[str, Any]], None]
NEGLIGIBLE_OFFSET = 1e-9  # m, rad: a smaller offset counts as zero
TEST_FORCE = 10.0  # N: force on the TCP under which a compliant model has an offset
TEST_POSES, SEED = 16, 14  # random poses at which the model is tried


class Exit(IntEnum):
    """Exit codes of the loop's process."""

    DONE = 0
    INPUT = 2
    LINK = 3
    CRASH = 4


class CycleInput(NamedTuple):
    """Input of one cycle."""

    state: RobotState
    missed: int  # cycles missed before it
    nominal_q: Array  # (n,) rad: of the robot's own program
    loads: Loads
    flags: int


class Loop:
    """One run of the loop in its process; ``run`` returns when it is over."""

    def __init__(
        self,
        settings: DaemonSettings,
        model: Model,
        driver: Driver,
        source: Source,
        memory: SharedMemory,
        emit: Emit,
        number: int = 0,
    ) -> None:
        self._number = number  # of this process of the loop, from 0
        self._settings, self._driver, self._source = settings, driver, source
        self._memory, self._emit = memory, emit
        clock, self._now = driver.clock, driver.clock.monotonic
        self._stream = SetpointStream(model, settings.limits, driver.rate, clock)
        self._loads = LiveLoads(
            model.arm.n, settings.setpoints.use_force, settings.setpoints.force_filter,
            LoadBounds.of(model),
        )  # fmt: skip
        self._last_loads = Loads()  # of the last cycle
        self._sent_q: Array | None = None  # nominal joints of the last setpoint, while writing
        self._model_check = ModelCheck(model, settings.setpoints.use_force)
        self._clock = ControllerClock(driver.rate, clock, hold_time(driver.rate))
        reports = Reports(memory, emit)
        self._supervisor = Supervisor(reports.transition)
        read_timeout = settings.link.state_timeout
        self._watch = LinkMonitor(driver, self._supervisor, reports, read_timeout)
        self._checks = LoopChecks(
            driver.rate, self._supervisor, reports, read_timeout, driver.moves_arm
        )
        self._in_force = self._open_offset_in_force()
        self._writing = Writing(
            settings.setpoints, driver, source, self._stream, self._supervisor, reports,
            self._in_force,
        )  # fmt: skip
        self._zero_moved = False  # reported by the daemon, not acknowledged
        self._acknowledged = False  # the fault is; it ends when the robot is ready
        self._beats, self._beaten = 0, 0.0  # of the daemon; s, monotonic: of the last one
        self._stop_by: float | None = None  # s, monotonic
        self._exit: Exit | None = None
        self._stop_requested = False

    def _open_offset_in_force(self) -> OffsetInForce:
        """Return the store of the offset that remains in the arm after a fault."""
        if not self._driver.moves_arm:  # the robot's program ramps it out
            return OffsetInForce(self._driver.n, None)
        return OffsetInForce.of_link(self._driver.n, self._settings.link)

    def request_stop(self) -> None:
        """Ramp out and end the loop; for signal handlers."""
        self._stop_requested = True

    # -- the frame --------------------------------------------------------------------------------

    def run(self, commands: Commands, may_write: bool, latched: str = "") -> Exit:
        """Connect and loop until a stop request, or until the link is lost.

        ``commands``: from the daemon; only they can arm. ``may_write`` False: arming is impossible.
        ``latched``: an unacknowledged fault of a former process of the loop.
        """
        self._memory.enter(Phase.CONNECTING)
        try:
            self._driver.connect()
        except LinkError as error:
            self._emit({"kind": EventKind.FAILURE, "detail": str(error)})
            return Exit.LINK
        self._watch.reset()
        self._supervisor.take(Cause.CONNECTED)
        if latched:
            self._supervisor.take(Cause.LATCHED, latched)
        self._memory.enter(Phase.RUNNING)
        wanted = False
        while self._exit is None:
            self._memory.beat()
            requests = commands.take()
            for command in requests:
                wanted = command == Command.ARM
                if command == Command.DISARM:  # one made before a slip was known leaves it
                    slipped = commands.number_of(Command.ZERO_MOVED)
                    self._zero_moved &= slipped > commands.number_of(Command.DISARM)
                if command in (Command.DISARM, Command.RAMP_OUT):
                    self._disarm(command == Command.DISARM)
                if command == Command.ZERO_MOVED:
                    self._on_zero_moved()
            if requests:
                self._memory.note_taken(commands.last_taken)
            self._watch_daemon(commands.beats)
            if self._stop_requested or commands.stop:
                self._stop()
            has_states = self._memory.has_state and self._checks.rate.known
            if wanted and may_write and has_states and self._stop_by is None:
                wanted = False
                self._arm()
            if self._exit is None:
                self._cycle()
        self._memory.enter(Phase.ENDING)
        self._source.close()
        return self._exit

    def _arm(self) -> None:
        """Arm, or emit why not."""
        if self._supervisor.state == State.FAULT:
            detail = "a fault is latched: acknowledge it first (gapbridge disarm)"
        elif self._checks.not_ready:
            detail = f"the robot is not ready: {self._checks.not_ready}"
        elif obstacle := self._arming_obstacle():
            detail = obstacle
        else:
            if self._supervisor.take(Cause.ARM):
                self._restart_checks()
            return
        self._emit({"kind": EventKind.REFUSED, "what": "arm", "detail": detail})

    def _arming_obstacle(self) -> str:
        """Return why arming is refused, as text; empty: it is not."""
        stream = self._stream
        if self._zero_moved:
            return "a joint's zero has moved: acknowledge it first (gapbridge disarm)"
        self._model_check.reset()
        if problem := self._checks.frozen or self._checks.rate.problem:
            return problem
        if self._loads.problem is not None:
            return f"the load is implausible: {self._loads.problem}"
        if not stream.finite:
            return "the model's correction is no number at the present pose"
        if stream.unsolved:
            return f"the correction cannot be solved at the present pose: {stream.unsolved}"
        if not self._settings.uncorrected and not self._model_check.corrects(self._last_loads):
            return (
                "the model corrects nothing at any pose: found neither compliance nor an effect in "
                "the cell that moves the TCP under what acts now"
            )
        return ""

    def _watch_daemon(self, beats: int) -> None:
        """Ramp out where the daemon stands still: it passes no disarming on."""
        now = self._now()
        if beats != self._beats or not beats:
            self._beats, self._beaten = beats, now
        elif now - self._beaten > DAEMON_SILENT:
            detail = f"no heartbeat of the daemon for {DAEMON_SILENT:g} s: nobody could disarm"
            self._supervisor.take(Cause.DAEMON_SILENT, detail)

    def _on_zero_moved(self) -> None:
        """Ramp out: the zero of a joint has moved, so that every pose is wrong."""
        self._zero_moved = True
        self._memory.count(LoopCounter.ZERO_MOVED)
        self._supervisor.take(Cause.ZERO_MOVED, "the slip was reported just before")

    def _disarm(self, by_a_person: bool) -> None:
        if (
            self._supervisor.state == State.OBSERVING
        ):  # asked by a person, or after a verification that passed
            self._checks.acknowledge()
        if self._supervisor.state == State.FAULT:
            self._acknowledged |= by_a_person
        else:
            self._supervisor.take(Cause.DISARM)

    def _restart_checks(self) -> None:
        """Restart clock, checks and link monitor after a time without reading states.

        What the source received meanwhile is of unknown age.
        """
        self._source.discard()
        self._clock.skip()
        self._checks.reset()
        self._watch.reset()

    def _stop(self) -> None:
        """Ramp out, then end; at the deadline in any case."""
        if self._stop_by is None:
            needed = STOP_TIMEOUT + longest_ramp_out(self._settings.limits)
            self._stop_by = self._now() + needed
            self._stream.shorten_ramp(STOP_RAMP_TIME)
            self._supervisor.take(Cause.STOP)
        if not self._supervisor.state.writes or self._now() > self._stop_by:
            self._release()
            self._supervisor.take(Cause.RAMPED_OUT, "not at rest in time")
            self._exit = Exit.DONE

    def _release(self) -> None:
        self._writing.release()
        self._check_writing()

    def _check_writing(self) -> None:
        """Act on the result of writing: states not read meanwhile, or a lost link."""
        if self._writing.take_paused():
            self._restart_checks()
        if self._writing.lost is not None:
            self._latch_stop()
        self._end_on_lost_link(self._writing.lost)

    def _latch_stop(self) -> None:
        """Latch a stop of the robot that has made a write fail before its state was read.

        As a failed write alone it would end with the link.
        """
        try:
            why = why_not_ready(self._driver.read_state())
        except LinkError:
            return
        if why and self._supervisor.take(Cause.UNSAFE, why):
            self._memory.count(LoopCounter.UNSAFE)

    def _end_on_lost_link(self, detail: str | None) -> None:
        """End this process if the link is lost (``detail``): only a new one may reconnect."""
        if detail is None or self._exit is not None:
            return
        self._memory.count(LoopCounter.LINK_LOST)
        self._supervisor.take(Cause.LINK_LOST, detail)
        self._emit({"kind": EventKind.FAILURE, "detail": detail})
        self._exit = Exit.LINK

    # -- one cycle --------------------------------------------------------------------------------

    def _cycle(self) -> None:
        state = self._watch.next(self._writing.has_armed)
        if state is None:
            self._end_on_lost_link(self._watch.lost)
            return
        try:
            nominal_q = self._driver.nominal_q(state)
        except InvalidStateError as error:
            self._watch.drop(error)
            self._end_on_lost_link(self._watch.lost)
            return
        missed = self._clock.take(state, transit_known=self._writing.ready)
        if self._writing.ready and (round_trip := self._driver.take_round_trip()) is not None:
            self._clock.measured(round_trip, self._writing.transit_time)
        expiry = self._clock.expiry(state) - self._writing.transit_time
        is_fresh = self._watch.accept(expiry)
        self._end_on_lost_link(self._watch.lost)
        self._memory.note_state_read()
        flags = self._checks.begin(state, missed)
        if flags & RESYNC:
            self._loads.reset()
            is_fresh = False  # how long it was queued only the next shows: clocks drift meanwhile
        self._acknowledge()
        supervisor, writing = self._supervisor, self._writing
        if writing.ready and not (supervisor.state.writes or supervisor.state == State.ARMED):
            self._release()  # a fault, or disarmed before the first setpoint
        if not (writing.ready or supervisor.state.writes):
            self._in_force.follow(nominal_q)
        loads = self._last_loads = self._loads.update(state, nominal_q, self._sent_q)
        self._checks.check_loads(self._loads.problem)
        self._checks.check_settings(state, self._driver)
        start = self._now()
        if is_fresh and supervisor.state == State.ARMED:
            used_up = writing.start(state, nominal_q)
            self._check_writing()
            if used_up:  # the state is too old now
                self._record(CycleInput(state, missed, nominal_q, loads, flags), None, since=start)
                return
        holding = supervisor.state == State.HOLDING
        if supervisor.state not in (State.ARMED, State.COMPENSATING):
            self._source.listen()
        writes = supervisor.state.writes
        written = None
        if writes:
            written = writing.write(state, nominal_q, loads, expiry if is_fresh else -np.inf)
            self._check_writing()
        if writes and writing.ramps_out:
            flags |= RAMPING_OUT
        if writes and writing.took_back:
            flags |= TOOK_BACK
        setpoint = writing.unsent if writes and written is None else written
        cycle_input = CycleInput(state, missed, nominal_q, loads, flags)
        self._record(cycle_input, setpoint, writes, written is not None)
        clamped = 0 if setpoint is None else self._stream.clamped
        commanded = nominal_q if written is None else written.q
        self._checks.end(state, commanded, clamped, self._now() - state.received)
        if written is not None and holding and writing.at_rest(written, state):
            self._release()  # takes a moment: after the cycle has been timed
            supervisor.take(Cause.RAMPED_OUT)

    def _acknowledge(self) -> None:
        """Leave an acknowledged fault once the robot is ready."""
        fault = self._supervisor.state == State.FAULT
        if self._acknowledged and fault and not self._checks.not_ready:
            self._acknowledged = False
            self._supervisor.take(Cause.ACKNOWLEDGED)

    def _record(
        self,
        cycle_input: CycleInput,
        setpoint: Setpoint | None,
        attempted: bool = False,
        sent: bool = False,
        since: float | None = None,
    ) -> None:
        """Publish a cycle: ``setpoint`` was computed for writing, and was ``sent`` or not."""
        memory, stream = self._memory, self._stream
        state, missed, nominal_q, loads, flags = cycle_input
        if setpoint is not None:
            self._sent_q = setpoint.nominal_q.copy()
        elif not attempted:
            self._sent_q = None
        if setpoint is None:
            correction = stream.correct(nominal_q, loads)
            wanted, corrected, offset = nominal_q, correction.q, correction.offset_in_base
            if not stream.finite:
                self._supervisor.take(Cause.BAD_OUTPUT, "the model's correction is no number")
            elif not self._model_check.corrects(loads):
                flags |= NOTHING
        else:
            wanted, corrected, offset = setpoint.nominal_q, setpoint.q, setpoint.offset_in_base
        if stream.unsolved:
            flags |= UNSOLVED
        clamped = stream.clamped if setpoint is not None else 0
        late = 0.0 if since is None else self._now() - since  # arming: no part of the cycle
        row, slices = memory.next_row(), memory.slices
        write_cycle(row, slices, state, wanted, corrected, offset)
        row[2] = self._supervisor.state
        row[3] = sent
        row[4] = missed
        row[5] = self._clock.age(state) - late
        row[6] = self._now() - state.received - late
        row[7] = clamped
        row[8] = stream.residual
        row[slices["own_q"]] = nominal_q
        row[slices["flags"].start] = flags
        last = slices["attempted"].start
        kind = UNSENT if setpoint is not None and not sent else int(attempted)
        row[last : last + 4] = (kind, stream.ramp_time, self._driver.rate, self._number)
        memory.publish()
        self._source.emit(
            SourceStatus(self._supervisor.state, wanted, corrected, offset, sent, clamped)
        )


class ModelCheck:
    """Whether a model has an offset at any pose; computed once, then stored."""

    def __init__(self, model: Model, use_force: bool) -> None:
        self._compensator = Compensator(model)
        limits, n = model.arm.limits, model.arm.n
        lower, upper = np.maximum(limits.lower, -np.pi), np.minimum(limits.upper, np.pi)
        self._poses = np.random.default_rng(SEED).uniform(lower, upper, (TEST_POSES, n))
        self._use_force = use_force
        self._known: bool | None = None

    def corrects(self, loads: Loads) -> bool:
        """Return whether a pose has an offset under these loads (one row) or a test force.

        Joints count as moved: those with play have an offset after their first motion.
        """
        if self._known is None:
            if loads.approach is not None:
                moved = np.where(loads.approach == 0.0, 1.0, loads.approach)
                loads = replace(loads, approach=moved)
            self._known = any(self._has_offset(q, loads) for q in self._poses)
        return self._known

    def reset(self) -> None:
        """Compute it again the next time: the loads may differ."""
        self._known = None

    def _has_offset(self, q: Array, loads: Loads) -> bool:
        wrench = np.zeros((1, 6)) if loads.wrench is None else loads.wrench
        tried = [wrench]
        if self._use_force:
            pulls = np.zeros((3, 1, 6))
            pulls[range(3), 0, range(3)] = TEST_FORCE
            tried += [wrench + pull for pull in pulls]
        for pull in tried:
            correction = self._compensator.correct(q, replace(loads, wrench=pull))
            size = np.abs(correction.offset_in_base).max()
            if not correction.residual < np.inf or size > NEGLIGIBLE_OFFSET:
                return True
        return False
