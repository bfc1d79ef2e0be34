"""The states of a run and what leads from one to the other: one explicit table."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum, StrEnum


class State(IntEnum):
    """What the loop is doing."""

    DISCONNECTED = 0
    OBSERVING = 1  # reads, computes, records; writes nothing
    ARMED = 2  # told to write; waits for the source's first setpoint
    COMPENSATING = 3  # writes; the offset ramps in and stays
    HOLDING = 4  # writes; the offset ramps out, the arm comes to rest
    FAULT = 5  # writes nothing

    @property
    def writes(self) -> bool:
        """Return whether setpoints leave in this state."""
        return self in (State.COMPENSATING, State.HOLDING)


class Cause(StrEnum):
    """Why a state was left."""

    CONNECTED = "connected"
    ARM = "arm"
    DISARM = "disarm"
    STOP = "stop"
    START_REFUSED = "start refused"
    WRITING = "writing"
    SOURCE_DRY = "source dry"
    SETPOINT_REFUSED = "setpoint refused"
    STALE = "state stale"
    SILENCE = "silence"
    UNSAFE = "robot not ready"
    WRITE_FAILED = "write failed"
    RAMPED_OUT = "ramped out"
    RECOVERED = "recovered"
    LINK_LOST = "link lost"


_S, _C = State, Cause
TRANSITIONS: dict[tuple[State, Cause], State] = {
    (_S.DISCONNECTED, _C.CONNECTED): _S.OBSERVING,
    (_S.OBSERVING, _C.ARM): _S.ARMED,
    (_S.OBSERVING, _C.SILENCE): _S.FAULT,
    (_S.ARMED, _C.DISARM): _S.OBSERVING,
    (_S.ARMED, _C.STOP): _S.OBSERVING,
    (_S.ARMED, _C.START_REFUSED): _S.OBSERVING,
    (_S.ARMED, _C.WRITING): _S.COMPENSATING,
    (_S.ARMED, _C.STALE): _S.OBSERVING,
    (_S.ARMED, _C.UNSAFE): _S.FAULT,
    (_S.ARMED, _C.WRITE_FAILED): _S.FAULT,
    (_S.COMPENSATING, _C.DISARM): _S.HOLDING,
    (_S.COMPENSATING, _C.STOP): _S.HOLDING,
    (_S.COMPENSATING, _C.SOURCE_DRY): _S.HOLDING,
    (_S.COMPENSATING, _C.SETPOINT_REFUSED): _S.HOLDING,
    (_S.COMPENSATING, _C.STALE): _S.HOLDING,
    (_S.COMPENSATING, _C.UNSAFE): _S.FAULT,
    (_S.COMPENSATING, _C.WRITE_FAILED): _S.FAULT,
    (_S.HOLDING, _C.RAMPED_OUT): _S.OBSERVING,
    (_S.HOLDING, _C.SETPOINT_REFUSED): _S.FAULT,
    (_S.HOLDING, _C.SILENCE): _S.FAULT,
    (_S.HOLDING, _C.UNSAFE): _S.FAULT,
    (_S.HOLDING, _C.WRITE_FAILED): _S.FAULT,
    (_S.FAULT, _C.RECOVERED): _S.OBSERVING,
    **{(s, _C.LINK_LOST): _S.DISCONNECTED for s in State},
}
"""(state, cause) -> next state. What is not in the table changes nothing.

Only a person's ARM leads to writing; no fault leads back to it.
"""

Listener = Callable[[State, State, Cause, str], None]


class Supervisor:
    """Holds the state; every change goes through the table and is told to one listener."""

    def __init__(self, listener: Listener) -> None:
        self.state = State.DISCONNECTED
        self._listener = listener

    def take(self, cause: Cause, detail: str = "") -> bool:
        """Change state as the table says; returns whether it did."""
        before = self.state
        after = TRANSITIONS.get((before, cause))
        if after is None:
            return False
        self.state = after
        self._listener(before, after, cause, detail)
        return True
