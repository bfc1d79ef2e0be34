"""The states of the loop, as shared memory, events and recordings carry them."""

from __future__ import annotations

from enum import IntEnum


class State(IntEnum):
    """What the loop is doing."""

    DISCONNECTED = 0
    OBSERVING = 1  # reads, computes, records; writes nothing
    ARMED = 2  # asked to write; waits for the source's first setpoint
    COMPENSATING = 3  # writes; the offset ramps in and stays
    HOLDING = 4  # writes; the offset ramps out, the arm comes to rest
    FAULT = 5  # writes nothing until a person has acknowledged it

    @property
    def writes(self) -> bool:
        """Return whether setpoints are sent in this state."""
        return self in (State.COMPENSATING, State.HOLDING)


def has_link(named: object) -> bool:
    """Return whether a status document's state is one with a link.

    Without one it is disconnected, or a text while the loop compiles.
    """
    return named in {state.name.lower() for state in State if state != State.DISCONNECTED}
