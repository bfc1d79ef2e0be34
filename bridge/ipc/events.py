"""Every event of a run: numbered, counted, kept for a while and handed to who wants it."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from gapbridge.drivers.clock import SYSTEM, Clock

KEPT = 500
Event = dict[str, Any]


class EventLog:
    """Numbers events and passes them on; ``listeners`` get each one, in order."""

    def __init__(self, *listeners: Callable[[Event], None], clock: Clock = SYSTEM) -> None:
        self._clock = clock
        self._listeners = listeners
        self.sequence = 0
        self.counts: Counter[str] = Counter()  # by kind, transitions also by their cause
        self.kept: deque[Event] = deque(maxlen=KEPT)

    def add(self, event: Event) -> Event:
        """Take an event; returns it with its number and times."""
        self.sequence += 1
        whole = {
            "kind": "note", "time": self._clock.time(), "monotonic": self._clock.monotonic(),
            **event,
            "sequence": self.sequence,
        }  # fmt: skip
        self.counts[whole["kind"]] += 1
        if whole["kind"] == "transition":
            self.counts[f"transition: {whole['cause']}"] += 1
        self.kept.append(whole)
        for listener in self._listeners:
            listener(whole)
        return whole

    def since(self, sequence: int) -> list[Event]:
        """Return the kept events after a number, from any thread."""
        return [event for event in tuple(self.kept) if event["sequence"] > sequence]
