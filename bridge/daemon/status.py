"""The present status of a run, for the status document."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop.checks import NOTHING, UNSOLVED
from gapbridge.bridge.loop.supervisor import CLEARED_BY_RECONNECTING, Cause
from gapbridge.core.arrays import Array
from gapbridge.drivers.clock import Clock

RATE_SPAN = 2.0  # s over which the rate is averaged


def correction(flags: int, residual: float) -> dict[str, Any]:
    """Return the status document's part on the model at the present pose.

    ``flags`` of a cycle; ``residual``: distance of the corrected pose from the wanted one, m.
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
    """Keeps what the status document reports; ``slices``: where fields are in a cycle's row."""

    def __init__(self, slices: dict[str, slice], clock: Clock) -> None:
        self._now = clock.monotonic
        self.started = self._since = clock.time()
        self._why = ""
        self._down = False  # the loop has ended and no other is connected
        self.armed_by = ""
        self._asked_by = ""  # of the last request to arm
        self._fault = ""  # of the loop, not acknowledged yet
        self._clears_with_link = False  # that fault ends with the link
        self._slip = ""  # a joint's zero that moved, not acknowledged yet: kept beside any fault
        self._unverified = ""  # why the last verification failed, until its mark is removed
        self._batches: deque[tuple[float, int]] = deque()  # s, cycles
        self._last_state: float | None = None  # s, monotonic: when the last state was received
        self._received = slices["received"].start
        self._flags = slices["flags"].start
        self._residual_at = slices["residual"].start
        self._correction = (0, 0.0)  # flags and residual, m, of the last cycle
        self.configured: Event = {}  # the last attempt to reload
        self._compiling = ""  # what the loop's process compiles before its first cycle

    @property
    def latched(self) -> str:
        """Return what is not acknowledged yet, a moved zero or a fault; empty: nothing."""
        return self.zero_moved or self._fault

    @property
    def zero_moved(self) -> str:
        """Return why the joints' zeros are not trusted: slip, failed verification; empty: are."""
        return self._unverified or self._slip

    @property
    def unacknowledged(self) -> tuple[str, str]:
        """Return the failed verification and the slip that nobody has acknowledged; empty: none."""
        return self._unverified, self._slip

    @property
    def lasting(self) -> str:
        """Return what stays latched without this link and this daemon; empty: nothing."""
        return self._slip or ("" if self._clears_with_link else self._fault)

    def restore(self, fault: str) -> None:
        """Latch a fault of a daemon that died before it was acknowledged; empty: none."""
        self._fault = fault

    def take(self, rows: Array) -> None:
        """Update from cycles: rows (k, width)."""
        now = self._now()
        if len(rows):
            self._last_state = float(rows[-1, self._received])
            self._correction = int(rows[-1, self._flags]), float(rows[-1, self._residual_at])
            self._batches.append((now, len(rows)))
        while self._batches and now - self._batches[0][0] > RATE_SPAN:
            self._batches.popleft()

    def on_event(self, event: Event) -> None:
        """Update from an event."""
        if event["kind"] == EventKind.CONFIGURATION:
            self.configured = event
        if event["kind"] == EventKind.REQUEST and event["command"] == "arm":
            self._asked_by = event["by"]
        if event["kind"] == EventKind.SLIP:
            self._slip = event["detail"]
        if event["kind"] == EventKind.VERIFICATION:
            self._unverified = "" if event["holds"] else event["detail"]
        if event["kind"] == EventKind.REQUEST and event["acknowledges"]:
            self._slip = ""
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
            if cause != Cause.LATCHED:  # else the fault is known
                self._fault, self._clears_with_link = self._why, cause in CLEARED_BY_RECONNECTING
        elif event["from"] == State.FAULT.name and to == State.OBSERVING.name:
            self._fault = ""
        if to == State.DISCONNECTED.name:
            self.lost_loop()
        if to == State.ARMED.name:
            self.armed_by = self._asked_by
        if to not in (State.ARMED.name, State.COMPENSATING.name, State.HOLDING.name):
            self.armed_by = ""

    def named(self, state: State) -> str:
        """Return the state's name in the document, which has one more for compiling."""
        name = state.name.lower()
        return (self._compiling or name) if state == State.DISCONNECTED else name

    def lost_loop(self) -> None:
        """Record that link and loop have ended: faults of the link end with them."""
        self._compiling = ""
        if self._clears_with_link:
            self._fault, self._clears_with_link = "", False
        self.armed_by = ""

    def history(self) -> dict[str, Any]:
        """Return since when the loop is in its state, and why."""
        return {"since": self._since, "why": self._why}

    @property
    def correction(self) -> dict[str, Any]:
        """Return the document's part on the model at the present pose."""
        return correction(*self._correction)

    def link(self) -> dict[str, float | None]:
        """Return the age of the last state, s, and the rate of states, Hz."""
        now, batches = self._now(), tuple(self._batches)
        rate = sum(n for _, n in batches[1:]) / max(now - batches[0][0], 1e-9) if batches else 0.0
        return {
            "age": None if self._last_state is None else now - self._last_state,
            "rate_hz": rate if len(batches) > 1 else 0.0,
        }
