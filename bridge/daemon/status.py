"""What the daemon knows of its run at a moment, as the status document."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop.checks import NOTHING, UNSOLVED
from gapbridge.bridge.loop.supervisor import CLEARED_BY_RECONNECTING, Cause
from gapbridge.core.arrays import Array
from gapbridge.drivers.clock import SYSTEM, Clock

RATE_SPAN = 2.0  # s that the rate is taken over


def correction(flags: int, residual: float) -> dict[str, Any]:
    """Return what the status document says of the model at the present pose.

    ``flags`` of a cycle; ``residual``: its correction's distance from the wanted pose, m.
    """
    detail = ""
    if flags & UNSOLVED:
        detail = "the model has no correction at the present pose: nothing is corrected"
    elif flags & NOTHING:
        detail = "the model corrects nothing: found neither compliance nor an effect that acts"
    return {
        "solved": not flags & UNSOLVED,
        "residual": residual if math.isfinite(residual) else None,
        "detail": detail,
    }


class DaemonStatus:
    """Keeps of cycles and events what the status document says; ``slices`` of a cycle's row."""

    def __init__(self, slices: dict[str, slice], clock: Clock = SYSTEM) -> None:
        self._now = clock.monotonic
        self.started = self._since = clock.time()
        self._why = ""
        self._down = False  # the loop has ended and no other is connected
        self.armed_by = ""
        self._asked_by = ""  # of the last request to arm
        self.latched = ""  # the fault that waits for being acknowledged
        self._clears_with_link = False  # it ends with the link
        self._slipped = False  # it is a joint's zero, of which the loop only holds
        self._batches: deque[tuple[float, int]] = deque()  # s, cycles
        self._last_state: float | None = None  # s, monotonic: when the last state was received
        self._received = slices["received"].start
        self._flags = slices["flags"].start
        self._residual_at = slices["residual"].start
        self._correction = (0, 0.0)  # flags and residual, m, of the last cycle
        self.configured: Event = {}  # the last attempt to reload
        self._compiling = ""  # what the loop's process is at before its first cycle

    def take(self, rows: Array) -> None:
        """Take note of cycles."""
        now = self._now()
        if len(rows):
            self._last_state = float(rows[-1, self._received])
            self._correction = int(rows[-1, self._flags]), float(rows[-1, self._residual_at])
            self._batches.append((now, len(rows)))
        while self._batches and now - self._batches[0][0] > RATE_SPAN:
            self._batches.popleft()

    def on_event(self, event: Event) -> None:
        """Take note of an event."""
        if event["kind"] == EventKind.CONFIGURATION:
            self.configured = event
        if event["kind"] == EventKind.REQUEST and event["command"] == "arm":
            self._asked_by = event["by"]
        if event["kind"] == EventKind.SLIP:
            self.latched, self._clears_with_link, self._slipped = event["detail"], False, True
        if event["kind"] == EventKind.REQUEST and event["acknowledges"] and self._slipped:
            self.latched, self._slipped = "", False
        if event["kind"] == EventKind.COMPILING:
            self._compiling = event["detail"]
        if event["kind"] == EventKind.GRANTED:  # compiled, and about to connect
            self._compiling = ""
        if event["kind"] in (EventKind.FAULT, EventKind.FAILURE):  # the loop's process ends
            if not self._down:
                self._since, self._down = event["time"], True
            self._why = event["detail"]
        if event["kind"] != EventKind.TRANSITION:
            return
        self._compiling = ""
        to, cause, detail = event["to"], event["cause"], event["detail"]
        self._since, self._down = event["time"], to == State.DISCONNECTED.name
        self._why = f"{cause}: {detail}" if detail else cause
        if to == State.FAULT.name:
            if cause != Cause.LATCHED:  # else it is the one that is known already
                self.latched, self._clears_with_link = self._why, cause in CLEARED_BY_RECONNECTING
        elif event["from"] == State.FAULT.name and to == State.OBSERVING.name:
            self.latched = ""
        if to == State.DISCONNECTED.name:
            self.lost_loop()
        if to == State.ARMED.name:
            self.armed_by = self._asked_by
        if to not in (State.ARMED.name, State.COMPENSATING.name, State.HOLDING.name):
            self.armed_by = ""

    def named(self, state: State) -> str:
        """Return the state as the document names it: compiling is one of its own."""
        return (
            self._compiling
            if state == State.DISCONNECTED and self._compiling
            else (state.name.lower())
        )

    def lost_loop(self) -> None:
        """Take note that link and loop are gone: faults of the link end with them."""
        self._compiling = ""
        if self._clears_with_link:
            self.latched, self._clears_with_link = "", False
        self.armed_by = ""

    def history(self) -> dict[str, Any]:
        """Return since when the state is what it is, and why."""
        return {"since": self._since, "why": self._why}

    @property
    def correction(self) -> dict[str, Any]:
        """Return what the document says of the model at the present pose."""
        return correction(*self._correction)

    def link(self) -> dict[str, float | None]:
        """Return how old the last state is, s, and how many come in a second."""
        now, batches = self._now(), tuple(self._batches)
        rate = sum(n for _, n in batches[1:]) / max(now - batches[0][0], 1e-9) if batches else 0.0
        return {
            "age": None if self._last_state is None else now - self._last_state,
            "rate_hz": rate if len(batches) > 1 else 0.0,
        }
