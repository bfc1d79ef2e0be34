"""What the loop counts, by kind: words of the shared memory, so that no crash loses a count."""

from __future__ import annotations

from enum import IntEnum

from gapbridge.core.errors import Implausible


class LoopCounter(IntEnum):
    """Places of the counters; the name in small letters is what people read."""

    LATE = 0  # no new state by the deadline; the last offset stays
    STALE = 1  # the controller's clock stood still for longer than the hold time
    DROPPED_TORN = 2  # the driver could not believe the sample: torn, short, wrong answer
    DROPPED_NOT_FINITE = 3
    DROPPED_IMPLAUSIBLE = 4
    DROPPED_STEP = 5
    DROPPED_BACKWARDS = 6
    FROZEN = 7  # values stood still while the clock went on
    BAD_OUTPUT = 8  # the model's correction was no number
    SATURATED = 9  # the offset stood at its envelope for too long
    OVERRUN = 10  # too many deadlines missed within a second
    RESYNC = 11  # a gap so long that what was before means nothing
    UNSAFE = 12  # protective stop, emergency stop, mode
    FOREIGN = 13  # another commander
    WRITE_INEFFECTIVE = 14
    WRITE_PARTIAL = 15
    WRITE_FAILED = 17
    SETPOINT_REFUSED = 18  # by the limiter
    SOURCE_DRY = 19
    SENSOR_LOST = 20  # force terms dropped
    SILENCE = 21
    LINK_LOST = 22
    UNSOLVED = 23  # the model's correction did not meet the wanted pose
    LOAD = 24  # a payload or force that the arm cannot bear
    NOT_FOLLOWING = 25  # the robot's program does not play, or at another speed
    MISMATCH = 26  # the controller is set otherwise than the cell says
    ZERO_MOVED = 27  # a joint's zero has slipped, as the daemon's watch has found

    @property
    def label(self) -> str:
        """Return the name as people and metrics have it."""
        return self.name.lower()


DROPPED = {
    Implausible.TORN: LoopCounter.DROPPED_TORN,
    Implausible.NOT_FINITE: LoopCounter.DROPPED_NOT_FINITE,
    Implausible.VALUE: LoopCounter.DROPPED_IMPLAUSIBLE,
    Implausible.STEP: LoopCounter.DROPPED_STEP,
    Implausible.BACKWARDS: LoopCounter.DROPPED_BACKWARDS,
}
"""Why a sample could not be believed -> where it is counted."""
