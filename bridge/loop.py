"""The loop: read a state, check it, compensate, limit, write. One owner of the link.

No setpoint leaves without a fresh, valid state behind it; starting never moves the arm; silence is
a fault. What the loop is doing is one of the states in supervisor.py.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge.controller_clock import ControllerClock
from bridge.cycle_row import fill_row
from bridge.daemon_settings import DaemonSettings
from bridge.live_loads import LiveLoads
from bridge.setpoint_source.source import Source, SourceDryError, Told
from bridge.setpoint_stream import SetpointStream
from bridge.shared_page import Command, Page, Phase
from bridge.state_watch import StateWatch
from bridge.supervisor import Cause, State, Supervisor
from core.errors import InvalidStateError, LimitError, LinkError, WriteError
from core.loads import Loads
from core.model import Model
from core.setpoint import Setpoint
from core.state import RobotState
from drivers.driver import Driver

Vector = NDArray[np.float64]
SETTLED, LONGEST_SETTLING = 2e-6, 0.3  # rad, s
ROBOT_RUNNING, SAFE = 7, (1, 2)  # robot_mode; safety_mode normal, reduced

LONGEST_STOP = 1.0  # s from a request to stop to letting go, at rest or not
HASTY_RAMP = 0.5  # s: what a stop takes for the ramp at most

Tell = Callable[[dict[str, Any]], None]


class Exit(IntEnum):
    """Exit codes of the loop's process."""

    DONE = 0
    INPUT = 2
    LINK = 3
    CRASH = 4


class Loop:
    """One run of the loop in its process; ``run`` returns when it is over."""

    def __init__(
        self,
        settings: DaemonSettings,
        model: Model,
        driver: Driver,
        source: Source,
        page: Page,
        tell: Tell,
        number: int = 0,
    ) -> None:
        self._number = number  # which process of the loop this is, from 0
        self._settings, self._driver, self._source = settings, driver, source
        self._page, self._tell = page, tell
        self._stream = SetpointStream(model, settings.limits, driver.rate)
        self._loads = LiveLoads(
            model.arm.n, settings.setpoints.use_force, settings.setpoints.force_filter
        )
        self._clock = ControllerClock(driver.rate)
        self._supervisor = Supervisor(self._changed)
        self._watch = StateWatch(driver, self._supervisor, tell, self._lose)
        self._ready_to_write = False  # the driver is armed
        self._settling = 0.0  # s, monotonic: since when the last setpoint stands
        self._stop_by: float | None = None  # s, monotonic
        self._exit: Exit | None = None
        self.stop_requested = False  # set by signal handlers

    # -- the frame --------------------------------------------------------------------------------

    def run(self, arm: bool, may_write: bool) -> Exit:
        """Connect and loop until told to stop, or until the link is lost.

        ``arm``: arm as soon as a state is there. ``may_write`` False: nothing can arm.
        """
        self._page.enter(Phase.CONNECTING)
        try:
            self._driver.connect()
        except LinkError as error:
            self._tell({"failure": str(error)})
            return Exit.LINK
        self._watch.believe()
        self._supervisor.take(Cause.CONNECTED)
        self._page.enter(Phase.RUNNING)
        wanted = arm
        while self._exit is None:
            self._page.beat()
            command = self._page.take_command()
            if self.stop_requested or command == Command.STOP:
                self._stop()
            elif command == Command.DISARM:
                self._supervisor.take(Cause.DISARM)
            elif command == Command.ARM:
                wanted = True
            if wanted and may_write and self._page.seen and self._stop_by is None:
                wanted = False
                self._supervisor.take(Cause.ARM)
            if self._exit is None:
                self._cycle()
        self._page.enter(Phase.ENDING)
        self._source.close()
        return self._exit

    def _changed(self, before: State, after: State, cause: Cause, detail: str) -> None:
        self._page.tell_state(after)
        self._tell({"from": before.name, "to": after.name, "cause": cause.value, "detail": detail})
        if after == State.ARMED:
            self._clock.skip()

    def _stop(self) -> None:
        """Ramp out, then end; a deadline makes sure of the end."""
        if self._stop_by is None:
            self._stop_by = time.monotonic() + LONGEST_STOP
            self._stream.hasten(HASTY_RAMP)
            self._supervisor.take(Cause.STOP)
        if not self._supervisor.state.writes or time.monotonic() > self._stop_by:
            self._release()
            self._supervisor.take(Cause.RAMPED_OUT, "not at rest in time")
            self._exit = Exit.DONE

    def _lose(self, detail: str) -> None:
        """Give the process up: a link that broke is only safe in a new one."""
        self._supervisor.take(Cause.LINK_LOST, detail)
        self._exit = Exit.LINK

    # -- one cycle --------------------------------------------------------------------------------

    def _cycle(self) -> None:
        state = self._watch.next()
        if state is None:
            return
        try:
            own = self._driver.nominal_q(state)
        except InvalidStateError as error:
            self._watch.doubt(str(error))
            return
        self._watch.believe()
        missed = self._clock.take(state)
        self._page.tell_seen()
        self._check_robot(state)
        loads = self._loads.update(state)
        if self._supervisor.state == State.ARMED and self._start(state, own):
            self._record(state, missed, own, loads, None)
            return  # the state is old by now
        holding = self._supervisor.state == State.HOLDING
        writes = self._supervisor.state.writes
        written = self._write(state, own, loads) if writes else None
        self._record(state, missed, own, loads, written, writes)
        if written is not None and holding and self._at_rest(written, state):
            self._release()  # takes a moment: after the cycle has been timed
            self._supervisor.take(Cause.RAMPED_OUT)

    def _check_robot(self, state: RobotState) -> None:
        """Take note of a robot that cannot move, and of its coming back."""
        fine = state.robot_mode == ROBOT_RUNNING and state.safety_mode in SAFE
        if not fine:
            self._supervisor.take(
                Cause.UNSAFE, f"robot_mode {state.robot_mode}, safety_mode {state.safety_mode}"
            )
            self._ready_to_write = False
        elif self._supervisor.state == State.FAULT:
            self._supervisor.take(Cause.RECOVERED)

    def _start(self, state: RobotState, own: Vector) -> bool:
        """Begin writing once the source has a first setpoint and the driver is ready.

        Returns whether it took so long that a fresh state is needed.
        """
        first = self._source.first(own)
        if first is None:
            if self._ready_to_write:
                self._refuse_start("the source fell silent before the first setpoint")
            return False
        away = np.abs(first - own)
        tolerance = self._settings.setpoints.start_tolerance
        if not (away <= tolerance).all():
            joint = int(np.argmax(away))
            self._refuse_start(
                f"joint {joint + 1}: found the first setpoint {away[joint]:.4f} rad from the arm, "
                f"expected at most {tolerance:g} (setpoints.start_tolerance)"
            )
            return False
        try:
            if not self._ready_to_write:
                self._arm_driver(state)
                return True
            self._stream.start(own, state.timestamp)
        except (WriteError, LimitError) as error:
            self._refuse_start(str(error))
            return True
        self._source.begin(state.timestamp, own)
        self._supervisor.take(Cause.WRITING)
        return False

    def _arm_driver(self, state: RobotState) -> None:
        """Make the driver ready, which takes a moment: a fresh state is needed after it."""
        self._page.enter(Phase.ARMING)
        self._watch.has_written = True
        try:
            self._driver.arm(state)
            self._ready_to_write = True
        finally:
            self._page.enter(Phase.RUNNING)
            self._clock.skip()

    def _refuse_start(self, detail: str) -> None:
        self._release()
        self._supervisor.take(Cause.START_REFUSED, detail)

    def _write(self, state: RobotState, own: Vector, loads: Loads) -> Setpoint | None:
        """Send one setpoint; returns it, or None where none has left."""
        source_q = self._next(state, own)
        holding = self._supervisor.state == State.HOLDING
        try:
            setpoint = self._stream.advance(state, source_q, loads, 0.0 if holding else 1.0)
            self._driver.write_setpoint(setpoint)
        except LimitError as error:
            self._stream.forget()
            self._supervisor.take(Cause.SETPOINT_REFUSED, str(error))
            if not self._supervisor.state.writes:
                self._release()
            return None
        except WriteError as error:
            self._stream.forget()
            self._supervisor.take(Cause.WRITE_FAILED, str(error))
            self._ready_to_write = False
            self._lose(str(error))
            return None
        return setpoint

    def _at_rest(self, setpoint: Setpoint, state: RobotState) -> bool:
        """Return whether the offset is out, and the arm, where it is ours, stands.

        The controller's target follows late: who lets go at once leaves the arm short of it.
        """
        if not self._driver.moves_arm:
            return self._stream.is_bare
        if not self._stream.rests:
            return False
        now = time.monotonic()
        self._settling = self._settling or now
        near = bool((np.abs(state.target_q - setpoint.q) < SETTLED).all())
        if near or now - self._settling > LONGEST_SETTLING:
            self._settling = 0.0
            return True
        return False

    def _next(self, state: RobotState, own: Vector) -> Vector | None:
        """Return the source's setpoint; None: the motion must brake."""
        if self._supervisor.state == State.HOLDING:
            return None if self._driver.moves_arm else own
        try:
            found = self._source.sample(state.timestamp, own)
        except SourceDryError as error:
            self._supervisor.take(Cause.SOURCE_DRY, str(error))
            return None if self._driver.moves_arm else own
        if self._source.ended and not self._page.ended:
            self._page.tell_ended()
            self._tell({"ended": "the source has come to its end; the arm stays there"})
        return found

    def _release(self) -> None:
        """Leave the robot to itself; the arm has come to rest, or its watchdog stops it."""
        self._stream.end()
        if not self._ready_to_write:
            return
        self._ready_to_write = False
        self._page.enter(Phase.ARMING)
        try:
            self._driver.release()
        except WriteError as error:
            self._tell({"release": str(error)})
        self._page.enter(Phase.RUNNING)
        self._clock.skip()

    def _record(
        self, state: RobotState, missed: int, own: Vector, loads: Loads,
        setpoint: Setpoint | None, attempted: bool = False,
    ) -> None:  # fmt: skip
        page, stream = self._page, self._stream
        if setpoint is None:
            correction = stream.correct(own, loads)
            nominal, corrected, offset = own, correction.q, correction.offset_in_base
        else:
            nominal, corrected, offset = setpoint.nominal_q, setpoint.q, setpoint.offset_in_base
        row = page.next_row()
        fill_row(row, page.slices, state, nominal, corrected, offset)
        row[2] = self._supervisor.state
        row[3] = setpoint is not None
        row[4] = missed
        row[5] = self._clock.age(state)
        row[6] = time.monotonic() - state.received
        row[7] = stream.clamped if setpoint is not None else 0
        row[8] = stream.residual
        slices = page.slices
        row[slices["own_q"]] = own
        row[slices["flags"].start] = 0.0
        at = slices["attempted"].start
        row[at : at + 4] = (attempted, stream.ramp_time, self._driver.rate, self._number)
        page.publish()
        self._source.tell(
            Told(
                self._supervisor.state,
                nominal,
                corrected,
                offset,
                setpoint is not None,
                stream.clamped if setpoint is not None else 0,
            )
        )
