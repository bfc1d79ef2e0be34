"""The loop's reports to the daemon: counts and state in shared memory, events over a socket."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.loop_counters import LoopCounter
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.loop.supervisor import Cause


@dataclass(frozen=True)
class Reports:
    """The channels by which every part of the loop reports."""

    memory: SharedMemory
    emit: Callable[[dict[str, Any]], None]  # one event; never blocks

    def count(self, what: LoopCounter, times: int = 1) -> None:
        """Count an event."""
        self.memory.count(what, times)

    def transition(self, before: State, after: State, cause: Cause, detail: str) -> None:
        """Report a change of state: listener of a Supervisor."""
        self.memory.note_state(after)
        self.emit(
            {"kind": EventKind.TRANSITION, "from": before.name, "to": after.name,
             "cause": cause.value, "detail": detail, "cycle": self.memory.written}
        )  # fmt: skip
