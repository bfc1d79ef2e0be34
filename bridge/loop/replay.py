"""The loop on a recording: it computes anew, and is in the states that it was in then.

Who armed, what ran dry and when, is the recording's; the correction, the ramp and the limiter are
computed. With the same cell every offset comes out bit for bit as it was.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any, cast

from bridge.loop.checks import RAMPING_OUT, RESYNC
from bridge.loop.live_loads import LiveLoads
from bridge.loop.loop import UNSENT, Exit, Loop
from bridge.loop.setpoint_stream import SetpointStream
from bridge.loop.supervisor import Cause, State
from core.errors import LimitError
from core.load_bounds import LoadBounds
from core.loads import Loads
from core.model import Model
from core.setpoint import Setpoint
from core.state import RobotState
from drivers.replay import Cycle, EndOfRecordingError, ReplayDriver


class _Followed(StrEnum):
    """Why a replayed loop changes its state."""

    RECORDED = "as recorded"


class ReplayedLoop(Loop):
    """A loop whose driver is a recording."""

    def __init__(self, settings: Any, model: Model, driver: ReplayDriver, *more: Any) -> None:
        super().__init__(settings, model, driver, *more)
        self._model, self._recording = model, driver
        self._process: int | None = None  # of the loop then
        self._streaming = False  # between the first setpoint of a stream and its last

    def _cycle(self) -> None:
        try:
            state = self._recording.read_state()
        except EndOfRecordingError as error:
            self._page.tell_ended()
            self._tell({"kind": "note", "detail": str(error)})
            self._exit = Exit.DONE
            return
        cycle = self._recording.cycle
        assert cycle is not None
        if cycle.loop != self._process:
            self._renew(cycle.loop)
        missed = self._clock.take(state)
        self._page.tell_seen()
        if cycle.flags & RESYNC:
            self._loads.forget()
        loads = self._loads.update(state)
        self._checks.flags = cycle.flags
        self._follow(State(cycle.state))
        setpoint = self._write_again(cycle, state, loads)
        left = cycle.written and setpoint is not None
        self._record(state, missed, cycle.own_q, loads, setpoint, cycle.attempted > 0, left)

    def _renew(self, process: int) -> None:
        """Begin as a new process of the loop begins, knowing nothing of the former."""
        first, self._process = self._process is None, process
        if first:
            return
        settings = self._settings
        self._stream = SetpointStream(self._model, settings.limits, self._recording.rate)
        self._loads = LiveLoads(
            self._model.arm.n, settings.setpoints.use_force, settings.setpoints.force_filter,
            LoadBounds.of(self._model),
        )  # fmt: skip
        self._clock.skip()
        self._streaming = False

    def _follow(self, state: State) -> None:
        before = self._supervisor.state
        if state != before:
            self._supervisor.state = state
            self._changed(before, state, cast("Cause", _Followed.RECORDED), "")

    def _write_again(self, cycle: Cycle, state: RobotState, loads: Loads) -> Setpoint | None:
        """Compute the setpoint of a cycle that had one; None where none left."""
        stream = self._stream
        if not cycle.attempted:
            if self._streaming:
                stream.end()
            self._streaming = False
            return None
        try:
            if not self._streaming:
                stream.start(cycle.own_q, state.timestamp, led=True)
                self._streaming = True
            if not cycle.written and cycle.attempted != UNSENT:
                stream.forget()  # it was refused, and left no trace
                return None
            stream.hasten(cycle.ramp_time)
            goal = 0.0 if cycle.flags & RAMPING_OUT else 1.0
            setpoint = stream.advance(state, cycle.nominal_q, loads, goal)
        except LimitError as error:  # of another cell than it was then
            stream.forget()
            self._tell({"kind": "refused", "detail": str(error)})
            return None
        self._recording.write_setpoint(setpoint)
        return setpoint
