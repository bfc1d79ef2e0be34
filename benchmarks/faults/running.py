"""A daemon in a thread of this process; its loop and all else are processes as always."""

from __future__ import annotations

import math
import threading
from pathlib import Path
from typing import Any

from benchmarks.faults.punctual import go_first
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.run_settings import settings_of
from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.daemon.summary import RunSummary
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.drivers.clock import SYSTEM

BACKOFF = (0.1, 0.5)  # s before a restart: not to wait long between faults
WRITES = tuple(state.name for state in State if state.writes)
Event = dict[str, Any]


class SourceStatus:
    """What a run has reported: its events, with both clocks' times."""

    events: list[Event]

    def since(self, moment: float) -> list[Event]:
        """Return the events that happened after ``moment`` (s, wall clock)."""
        return [event for event in list(self.events) if event["time"] >= moment]

    def writing_spans(self) -> list[tuple[float, float]]:
        """Return from when until when the loop was in a state that writes, s monotonic."""
        spans, begun = [], None
        for event in list(self.events):
            if event["kind"] == "transition":
                if event["to"] in WRITES:
                    begun = event["monotonic"] if begun is None else begun
                    continue
            elif event["kind"] not in ("failure", "fault"):
                continue
            if begun is not None:
                spans.append((begun, event["monotonic"]))
                begun = None
        return spans if begun is None else [*spans, (begun, math.inf)]

    def last_words(self) -> str:
        """Return the last events in short."""
        return "; ".join(f"{e.get('kind')} {words_of(e)}" for e in self.events[-4:])


class Running(SourceStatus):
    """One run of the daemon; every event is kept, with its wall clock's time."""

    def __init__(self, cell: Path, observe: bool = False, **changed: Any) -> None:
        given = {"backoff": BACKOFF, **changed}
        settings = settings_of(load_cell(cell)).model_copy(update=given)
        self.events: list[Event] = []
        self.daemon = Daemon(settings, may_write=not observe, log=self.events.append, clock=SYSTEM)
        self.memory = self.daemon.memory
        self.summary: RunSummary | None = None
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True, name="daemon")

    def start(self) -> None:
        """Start it, observing."""
        self._thread.start()

    def _run(self) -> None:
        go_first()
        try:
            self.summary = self.daemon.run()
        except Exception as error:
            self.error = error

    @property
    def alive(self) -> bool:
        """Return whether it runs."""
        return self._thread.is_alive()

    @property
    def state(self) -> State:
        """Return the loop's state at this moment."""
        return State(self.memory.state) if self.daemon.loop_pid else State.DISCONNECTED

    def state_word(self) -> int:
        """Return the supervisor's state from the shared memory, -1 where that is gone."""
        try:
            return self.memory.state
        except (IndexError, ValueError):
            return -1

    def stop(self) -> None:
        """End it and wait."""
        self.daemon.stop()
        self._thread.join(30.0)
        if self._thread.is_alive():
            raise TimeoutError("the daemon did not end")


def words_of(event: Event) -> str:
    """Return an event in words."""
    if event.get("kind") == "transition":
        return f"{event['from']} -> {event['to']} ({event['cause']})"
    return str(event.get("detail", ""))[:120]
