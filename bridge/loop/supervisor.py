"""The state machine of the loop: one explicit table of transitions."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum

from gapbridge.bridge.ipc.loop_state import State


class Cause(StrEnum):
    """The cause of a transition."""

    CONNECTED = "connected"
    LATCHED = "fault latched"  # by a former process of the loop
    ARM = "arm"
    DISARM = "disarm"
    STOP = "stop"
    START_REFUSED = "start refused"
    WRITING = "writing"
    SOURCE_DRY = "source dry"
    SETPOINT_REFUSED = "setpoint refused"
    STALE = "state stale"
    IMPLAUSIBLE = "state implausible"
    FROZEN = "values frozen"
    RESYNC = "gap in time"
    OVERRUN = "deadlines missed"
    SATURATED = "offset saturated"
    BAD_OUTPUT = "correction no number"
    UNSOLVED = "correction unsolved"
    LOAD = "load implausible"
    NOT_FOLLOWING = "robot not following"
    MISMATCH = "robot set otherwise"
    FOREIGN = "another commander"
    INEFFECTIVE = "write without effect"
    ZERO_MOVED = "zero moved"
    DAEMON_SILENT = "daemon silent"
    SILENCE = "silence"
    UNSAFE = "robot not ready"
    WRITE_FAILED = "write failed"
    RAMPED_OUT = "ramped out"
    ACKNOWLEDGED = "acknowledged"
    LINK_LOST = "link lost"


_S, _C = State, Cause

STOPS_AT_ONCE = (_C.SILENCE, _C.UNSAFE, _C.WRITE_FAILED, _C.BAD_OUTPUT)
"""Faults after which nothing more is written, in any state."""

RAMPS_OUT = (
    _C.DISARM, _C.STOP, _C.SOURCE_DRY, _C.SETPOINT_REFUSED, _C.STALE, _C.IMPLAUSIBLE, _C.FROZEN,
    _C.RESYNC, _C.OVERRUN, _C.SATURATED, _C.UNSOLVED, _C.LOAD, _C.NOT_FOLLOWING, _C.MISMATCH,
    _C.FOREIGN, _C.INEFFECTIVE, _C.ZERO_MOVED, _C.DAEMON_SILENT,
)  # fmt: skip
"""Causes that end compensating by a ramp."""

TRANSITIONS: dict[tuple[State, Cause], State] = {
    (_S.DISCONNECTED, _C.CONNECTED): _S.OBSERVING,
    (_S.OBSERVING, _C.ARM): _S.ARMED,
    (_S.OBSERVING, _C.LATCHED): _S.FAULT,
    (_S.ARMED, _C.WRITING): _S.COMPENSATING,
    (_S.ARMED, _C.START_REFUSED): _S.OBSERVING,
    **{(_S.ARMED, cause): _S.OBSERVING for cause in RAMPS_OUT},
    **{(_S.ARMED, cause): _S.FAULT for cause in STOPS_AT_ONCE},
    **{(_S.COMPENSATING, cause): _S.HOLDING for cause in RAMPS_OUT},
    **{(_S.COMPENSATING, cause): _S.FAULT for cause in STOPS_AT_ONCE},
    (_S.HOLDING, _C.RAMPED_OUT): _S.OBSERVING,
    # if ramping out fails, writing ends
    (_S.HOLDING, _C.SETPOINT_REFUSED): _S.FAULT,
    (_S.HOLDING, _C.FOREIGN): _S.FAULT,
    (_S.HOLDING, _C.INEFFECTIVE): _S.FAULT,
    **{(_S.HOLDING, cause): _S.FAULT for cause in STOPS_AT_ONCE},
    (_S.FAULT, _C.UNSAFE): _S.FAULT,  # the stop that made a write fail; it stays latched
    (_S.FAULT, _C.ACKNOWLEDGED): _S.OBSERVING,
    **{(s, _C.LINK_LOST): _S.DISCONNECTED for s in State if s},
}
"""(state, cause) -> next state. A pair that is not in the table changes nothing.

Only ARM leads to writing; no fault leads back to it. While observing nothing is written, so that
no finding latches a fault: arming is refused while it lasts. FAULT ends by ACKNOWLEDGED, which only
a person can send, or with the link.
"""

CLEARED_BY_RECONNECTING = (_C.SILENCE, _C.WRITE_FAILED, _C.INEFFECTIVE)
"""Faults that end with the link: the next link begins in OBSERVING. All others stay latched, also
for a new link or process, until a person acknowledges them."""

Listener = Callable[[State, State, Cause, str], None]


class Supervisor:
    """Holds the state; every change goes through the table and is reported to one listener."""

    def __init__(self, listener: Listener) -> None:
        self.state = State.DISCONNECTED
        self._listener = listener

    def take(self, cause: Cause, detail: str = "") -> bool:
        """Change the state as the table says; returns whether it changed."""
        before = self.state
        after = TRANSITIONS.get((before, cause))
        if after is None:
            return False
        self.state = after
        self._listener(before, after, cause, detail)
        return True

    def follow(self, state: State, cause: Cause) -> bool:
        """Take the state of a recording, whatever the table says; returns whether it changed."""
        before, self.state = self.state, state
        if state != before:
            self._listener(before, state, cause, "")
        return state != before


def states_table() -> str:
    """Return the transition table in Markdown: the next state for each cause and state."""
    names = [state.name.lower() for state in State]
    lines = [f"| cause | {' | '.join(names)} |", "| --- " * (len(names) + 1) + "|"]
    for cause in Cause:
        after = [TRANSITIONS.get((state, cause)) for state in State]
        cells = ["" if state is None else state.name.lower() for state in after]
        lines.append(f"| {cause.value} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(states_table())
