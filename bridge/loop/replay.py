"""The loop on a recording: states of the loop are the recorded ones, setpoints are computed again.

Arming, a dry source and other transitions come from the recording; correction, ramp and limiter are
computed. With the same cell every offset is bit-identical to the recorded one.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any, cast

import numpy as np

from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop.checks import RAMPING_OUT, RESYNC, TOOK_BACK
from gapbridge.bridge.loop.live_loads import LiveLoads
from gapbridge.bridge.loop.loop import UNSENT, CycleInput, Exit, Loop
from gapbridge.bridge.loop.offset_in_force import InForce, OffsetInForce
from gapbridge.bridge.loop.setpoint_stream import SetpointStream
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.core.errors import GateError, LimitError
from gapbridge.core.load_bounds import LoadBounds
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.replay.driver import Cycle, EndOfRecordingError, ReplayDriver


class _ReplayCause(StrEnum):
    """Why a replayed loop changes its state."""

    RECORDED = "as recorded"


class ReplayedLoop(Loop):
    """A loop whose driver is a recording."""

    def __init__(self, settings: Any, model: Model, driver: ReplayDriver, *arguments: Any) -> None:
        super().__init__(settings, model, driver, *arguments)
        self._model, self._recording = model, driver
        self._process: int | None = None  # number of the recorded loop process
        self._streaming = False  # between the first setpoint of a stream and its last
        self._sent = False  # the last setpoint computed was

    def _open_offset_in_force(self) -> OffsetInForce:
        """Keep it in memory only: a recording moves no arm."""
        return OffsetInForce(self._driver.n, None)

    def _cycle(self) -> None:
        try:
            state = self._recording.read_state()
        except EndOfRecordingError as error:
            self._memory.note_ended()
            self._emit({"kind": EventKind.NOTE, "detail": str(error)})
            self._exit = Exit.DONE
            return
        cycle = self._recording.cycle
        assert cycle is not None
        if cycle.loop != self._process:
            self._renew(cycle.loop)
        missed = self._clock.take(state)
        self._memory.note_state_read()
        if cycle.flags & RESYNC:
            self._loads.reset()
        loads = self._loads.update(state, cycle.own_q, self._sent_q)
        self._follow(State(cycle.state))
        setpoint = self._write_again(cycle, state, loads)
        sent = cycle.written and setpoint is not None
        cycle_input = CycleInput(state, missed, cycle.own_q, loads, cycle.flags)
        self._record(cycle_input, setpoint, cycle.attempted > 0, sent)

    def _renew(self, process: int) -> None:
        """Reset all state, as a new process of the loop does."""
        first, self._process = self._process is None, process
        if first:
            return
        settings = self._settings
        self._stream = SetpointStream(
            self._model, settings.limits, self._recording.rate, self._recording.clock
        )
        self._loads = LiveLoads(
            self._model.arm.n, settings.setpoints.use_force, settings.setpoints.force_filter,
            LoadBounds.of(self._model),
        )  # fmt: skip
        self._sent_q = None
        self._clock.skip()
        self._streaming = False

    def _follow(self, state: State) -> None:
        changed = self._supervisor.follow(state, cast("Cause", _ReplayCause.RECORDED))
        if changed and state == State.ARMED:
            self._restart_checks()

    def _began_with(self, cycle: Cycle) -> InForce | None:
        """Return the offset in force that a recorded stream started with, or None."""
        offset = self._in_force.offset_at(cycle.own_q)
        if offset is None:
            return None
        before = cycle.nominal_q - cycle.own_q
        return offset if np.linalg.norm(before + offset.delta) < np.linalg.norm(before) else None

    def _write_again(self, cycle: Cycle, state: RobotState, loads: Loads) -> Setpoint | None:
        """Compute the setpoint of a cycle that had one; None if none was sent."""
        stream = self._stream
        if not cycle.attempted:
            if self._streaming:
                stream.end()
                self._recording.release()
            self._streaming = False
            return None
        try:
            if not self._streaming:
                in_force = self._began_with(cycle)
                stream.start(cycle.own_q, state.timestamp, led=True, in_force=in_force)
                self._recording.arm(state)
                self._streaming = True
            elif cycle.flags & TOOK_BACK:
                self._take_back()
            if not cycle.written and cycle.attempted != UNSENT:
                stream.reset_solver()  # it was refused
                return None
            stream.shorten_ramp(cycle.ramp_time)
            goal = 0.0 if cycle.flags & RAMPING_OUT else 1.0
            setpoint = stream.advance(state, cycle.nominal_q, loads, goal)
            self._sent = cycle.written
            if cycle.written:
                self._recording.write_setpoint(setpoint)
                self._in_force.note(setpoint.q, stream.joint_offset, setpoint.offset_in_base)
        except (LimitError, GateError) as error:  # the cell differs from the recorded one
            stream.reset_solver()
            self._emit({"kind": EventKind.REFUSED, "detail": str(error)})
            return None
        return setpoint

    def _take_back(self) -> None:
        """Go on from the setpoint before the last one, which was refused or has lapsed."""
        self._stream.take_back()
        if self._sent:
            self._recording.gate.take_back()
            self._in_force.take_back()
