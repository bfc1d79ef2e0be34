"""Every event of a run: numbered, counted, kept for a while and handed to who wants it."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from enum import StrEnum
from typing import Any

from gapbridge.drivers.clock import SYSTEM, Clock

KEPT = 500
Event = dict[str, Any]


class EventKind(StrEnum):
    """What an event is about; those of a side process are called as it is."""

    NOTE = "note"  # what a person may want to know
    TRANSITION = "transition"  # the supervisor changed state
    STATUS = "status"  # the status document, to side processes only
    REQUEST = "request"  # somebody asked to arm or to disarm
    CONTROL = "control"  # what a request over the local socket was answered
    REFUSED = "refused"  # writing cannot begin
    FAULT = "fault"  # the loop's process ended in disorder, or was ended
    FAILURE = "failure"  # why the loop's process is about to end
    WARNING = "warning"  # nothing is held back for it
    DEGRADED = "degraded"  # compensation goes on with less
    DROPPED = "dropped"  # a sample could not be believed
    LINK = "link"  # the link stalls
    SOURCE = "source"  # the setpoint source ended
    GRANTED = "granted"  # what the system granted the loop, which is compiled and about to connect
    COMPILING = "compiling"  # what the loop compiles
    CONFIGURATION = "configuration"  # the cell file was read again
    SLIP = "slip"  # a joint's zero has moved
    RECORDER = "recorder"  # the recorder's own
    SIDE = "side"  # a side process ended, stalled or emitted what is not its own
    SUMMARY = "summary"  # how the run went
    ENDED = "ended"  # the run is over


class EventLog:
    """Numbers events and passes them on; ``listeners`` get each one, in order."""

    def __init__(self, *listeners: Callable[[Event], None], clock: Clock = SYSTEM) -> None:
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
