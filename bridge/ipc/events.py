"""The events of a run: numbered, counted, stored for a while and passed to listeners."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from enum import StrEnum
from typing import Any

from gapbridge.drivers.clock import Clock

KEPT = 500
Event = dict[str, Any]


class EventKind(StrEnum):
    """The kind of an event; those of a side process have its name."""

    NOTE = "note"  # information
    TRANSITION = "transition"  # the supervisor changed state
    STATUS = "status"  # the status document, to side processes only
    CELL = "cell"  # the cell that the next loop runs with, to side processes only: it has secrets
    REQUEST = "request"  # somebody asked to arm or to disarm
    CONTROL = "control"  # the answer to a request over the local socket
    REFUSED = "refused"  # arming was refused
    FAULT = "fault"  # the loop's process failed or was killed
    FAILURE = "failure"  # why the loop's process is about to end
    WARNING = "warning"  # compensation goes on
    DEGRADED = "degraded"  # compensation goes on with less
    DROPPED = "dropped"  # a sample failed the plausibility check
    LINK = "link"  # the link stalls
    SOURCE = "source"  # the setpoint source ended
    GRANTED = "granted"  # real-time measures in force; the loop is compiled and about to connect
    COMPILING = "compiling"  # what the loop compiles
    CONFIGURATION = "configuration"  # the cell file was read again
    SLIP = "slip"  # a joint's zero has moved
    VERIFICATION = "verification"  # the mark of a failed verification has come or gone
    RECORDER = "recorder"  # the recorder's own
    SIDE = "side"  # a side process ended, stalled or emitted a foreign kind of event
    SUMMARY = "summary"  # of the run
    ENDED = "ended"  # the run is over


class EventLog:
    """Numbers events and passes them on; ``listeners`` get each one, in order."""

    def __init__(self, *listeners: Callable[[Event], None], clock: Clock) -> None:
        self._clock = clock
        self._listeners = listeners
        self.sequence = 0
        self.counts: Counter[str] = Counter()  # by kind, transitions also by their cause
        self.recent: deque[Event] = deque(maxlen=KEPT)

    def add(self, event: Event) -> Event:
        """Take an event; returns it with its number and times."""
        self.sequence += 1
        whole = {
            "kind": EventKind.NOTE,
            "time": self._clock.time(),
            "monotonic": self._clock.monotonic(),
            **event,
            "sequence": self.sequence,
        }
        self.counts[whole["kind"]] += 1
        if whole["kind"] == EventKind.TRANSITION:
            self.counts[f"transition: {whole['cause']}"] += 1
        self.recent.append(whole)
        for listener in self._listeners:
            listener(whole)
        return whole

    def since(self, sequence: int) -> list[Event]:
        """Return the kept events after a number, from any thread."""
        return [event for event in tuple(self.recent) if event["sequence"] > sequence]
