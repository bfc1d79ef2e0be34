"""What the daemon knows of its run at a moment, as the status document."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.daemon.status_document import SCHEMA
from gapbridge.bridge.ipc.events import Event
from gapbridge.bridge.loop.checks import NOTHING, UNSOLVED
from gapbridge.bridge.loop.supervisor import HEALED_BY_RECONNECTING, State

if TYPE_CHECKING:
    from gapbridge.bridge.daemon.daemon import Daemon

RATE_SPAN = 2.0  # s that the rate is taken over


def correction(flags: int, residual: float) -> dict[str, Any]:
    """Return what the status document says of the model at the present pose.

    ``flags`` of a cycle; ``residual``: its correction's distance from the wanted pose, m.
    """
    words = ""
    if flags & UNSOLVED:
        words = "the model has no correction at the present pose: nothing is corrected"
    elif flags & NOTHING:
        words = "the model corrects nothing: found neither compliance nor an effect that acts"
    return {
        "solved": not flags & UNSOLVED,
        "residual": residual if math.isfinite(residual) else None,
        "detail": words,
    }


class DaemonStatus:
    """Keeps what the document says beside what the daemon itself holds."""

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon
        self._started = self._since = time.time()
        self._why = ""
        self.armed_by = ""
        self._asked_by = ""  # of the last request to arm
        self.latched = ""  # the fault that waits for being acknowledged
        self._heals = False  # it ends with the link
        self._batches: deque[tuple[float, int]] = deque()  # s, cycles
        self._heard: float | None = None  # s, monotonic: when the last state was received
        self._received = daemon.page.slices["received"].start
        self._flags = daemon.page.slices["flags"].start
        self._residual_at = daemon.page.slices["residual"].start
        self._correction = (0, 0.0)  # flags and residual, m, of the last cycle
        self.configured: Event = {}  # the last attempt to reload

    def take(self, rows: NDArray[np.float64]) -> None:
        """Take note of cycles."""
        now = time.monotonic()
        if len(rows):
            self._heard = float(rows[-1, self._received])
            self._correction = int(rows[-1, self._flags]), float(rows[-1, self._residual_at])
            self._batches.append((now, len(rows)))
        while self._batches and now - self._batches[0][0] > RATE_SPAN:
            self._batches.popleft()

    def hear(self, event: Event) -> None:
        """Take note of an event."""
        if event["kind"] == "configuration":
            self.configured = event
        if event["kind"] == "request" and event["command"] == "arm":
            self._asked_by = event["by"]
        if event["kind"] != "transition":
            return
        to, cause, detail = event["to"], event["cause"], event["detail"]
        self._since = event["time"]
        self._why = f"{cause}: {detail}" if detail else cause
        if to == State.FAULT.name:
            if cause != "fault latched":  # else it is the one that is known already
                self.latched, self._heals = self._why, cause in HEALED_BY_RECONNECTING
        elif event["from"] == State.FAULT.name and to == State.OBSERVING.name:
            self.latched = ""
        if to == State.DISCONNECTED.name:
            self.lost_loop()
        if to == State.ARMED.name:
            self.armed_by = self._asked_by
        if to not in (State.ARMED.name, State.COMPENSATING.name, State.HOLDING.name):
            self.armed_by = ""

    def lost_loop(self) -> None:
        """Take note that link and loop are gone: faults of the link end with them."""
        if self._heals:
            self.latched, self._heals = "", False
        self.armed_by = ""

    def document(self) -> dict[str, Any]:
        """Return the status document; may be called from any thread."""
        daemon, now = self._daemon, time.monotonic()
        batches = tuple(self._batches)
        counted = daemon.page.counts()
        tally = daemon.tally
        return {
            "schema": SCHEMA,
            "time": time.time(),
            "pid": os.getpid(),
            "started": self._started,
            "session": daemon.session,
            "cell": str(daemon.settings.cell),
            "configuration_hash": daemon.configuration.hash,
            "configured": self.configured,
            "state": daemon.state.name.lower(),
            "since": self._since,
            "why": self._why,
            "may_write": daemon.may_write,
            "armed_by": self.armed_by,
            "latched": self.latched,
            "correction": correction(*self._correction),
            "loop": {
                "pid": daemon.loop_pid,
                "restarts": daemon.restarts,
                "phase": daemon.phase.name.lower(),
            },
            "link": {
                "driver": daemon.settings.link.driver,
                "age": None if self._heard is None else now - self._heard,
                "rate_hz": sum(n for _, n in batches[1:]) / max(now - batches[0][0], 1e-9)
                if len(batches) > 1
                else 0.0,
                "cycles": tally.cycles,
                "missed": tally.missed,
                "late": tally.late,
                "written": tally.written,
                "dropped": {
                    name.removeprefix("dropped_"): count
                    for name, count in counted.items()
                    if name.startswith("dropped_")
                },
            },
            "counts": counted,
            "events": dict(daemon.book.counts),
            "sides": daemon.sides.status(),
            "recording": None if daemon.recording is None else str(daemon.recording),
            "lost_rows": daemon.lost_rows,
        }
