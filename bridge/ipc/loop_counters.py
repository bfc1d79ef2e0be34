"""The loop's counters: words of the shared memory, so that a crash loses no count."""

from __future__ import annotations

from enum import IntEnum

from gapbridge.core.errors import Implausible


class LoopCounter(IntEnum):
    """Index of each counter; its name in lower case is its label."""

    LATE = 0  # no new state by the deadline; the last offset is held
    STALE = 1  # the controller's clock did not change for longer than the hold time
    DROPPED_TORN = 2  # the driver dropped the sample: torn, short, wrong answer
    DROPPED_NOT_FINITE = 3
    DROPPED_IMPLAUSIBLE = 4
    DROPPED_STEP = 5
    DROPPED_BACKWARDS = 6
    FROZEN = 7  # joint values did not change while the clock went on
    BAD_OUTPUT = 8  # the model's correction was no number
    SATURATED = 9  # the offset was at its limits for too long
    OVERRUN = 10  # too many deadlines missed within a second
    RESYNC = 11  # a gap after which filters restart
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
    LOAD = 24  # an implausible payload or force
    NOT_FOLLOWING = 25  # the robot's program does not run, or at another speed
    MISMATCH = 26  # the controller's settings differ from the cell's
    ZERO_MOVED = 27  # a joint's zero has slipped, found by the daemon

    @property
    def label(self) -> str:
        """Return its name in status documents and metrics."""
        return self.name.lower()


DROPPED = {
    Implausible.TORN: LoopCounter.DROPPED_TORN,
    Implausible.NOT_FINITE: LoopCounter.DROPPED_NOT_FINITE,
    Implausible.VALUE: LoopCounter.DROPPED_IMPLAUSIBLE,
    Implausible.STEP: LoopCounter.DROPPED_STEP,
    Implausible.BACKWARDS: LoopCounter.DROPPED_BACKWARDS,
}
"""Reason of an implausible sample -> its counter."""
