"""Notes of a fit, a calibration or a plan; ``bridge`` makes their text."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Any


class Reason(Enum):
    """What is noted; the comment lists the note's values."""

    # of any fit
    OUTLIERS = auto()  # rows
    NOT_CONVERGED = auto()
    SUM_KNOWN = auto()  # two parameters, their correlation
    DIFFERENCE_KNOWN = auto()  # two parameters, their correlation
    # of flexibilities from a log
    AT_ZERO = auto()  # parameters
    NO_FLEXIBILITY = auto()
    SESSION_FRAMES = auto()
    NOTHING_WRITTEN = auto()
    TOOL_WRITTEN = auto()
    LINKS_HELD = auto()
    LINKS_ESTIMATED = auto()
    TOOL_OFF_WRITTEN = auto()
    TOOL_OFF = auto()
    HELD = auto()  # parameter
    ACTS_LIKE = auto()  # parameter, pairs of share and parameter
    SHOWN_TOGETHER = auto()  # pairs of share and parameter
    # of a calibration's parameters
    ONLY_SUM = auto()  # parameter, the other
    ONLY_DIFFERENCE = auto()  # parameter, the other
    ONLY_TOGETHER = auto()  # parameter, the others
    HARDLY_SHOWN = auto()  # parameter
    NEVER_SHOWN = auto()  # parameter
    REDUNDANT = auto()  # parameter, those that it is equivalent to
    REDUNDANT_WITH_PLACE = auto()  # the same, with the place of instrument or target
    # of a calibration
    ON_BOUND = auto()  # parameters
    HELD_OUT_FAR = auto()  # rows, from 1
    LOADS_AT_ODDS = auto()
    SAME_LOADS = auto()
    VERIFYING_FITTED = auto()  # readings
    FRAME_FITTED = auto()
    FEW_NUMBERS = auto()  # how many
    # of a calibration's residual
    NOTHING = auto()
    UNCONVERGED = auto()
    EFFECTS_MISSING = auto()  # pairs of effect and share of the residual
    EFFECTS_ACCUSED = auto()  # effects
    STRUCTURE = auto()
    FAR_OFF = auto()  # times as far as predicted
    # of a session at the flange
    NOTHING_WEIGHS = auto()
    NEGATIVE_MASS = auto()  # kg
    READINGS_DOWN = auto()  # rows, from 1
    TOUCHES_DOWN = auto()  # rows, from 1
    # of a plan
    NOT_IDENTIFIABLE = auto()  # parameters
    IDLE_LOADS = auto()  # kg
    ONE_LOAD = auto()
    SIGHT_UNKNOWN = auto()
    DETOURS = auto()  # pairs of stops, from 1
    FEW_POSES = auto()  # RejectedPoses
    FEW_HELD_OUT = auto()  # held-out poses, of how many
    # of a recording that is read as a log
    NO_STAMPS = auto()  # topic, messages without a stamp, messages
    NO_TARGET = auto()
    WRENCH_UNKNOWN = auto()  # topics, columns that it could be
    POSE_UNNAMED = auto()  # topics
    NO_ROTATION = auto()  # topic, messages without one, messages
    TAKEN_AS = auto()  # topic, column, frame
    EFFORT_UNKNOWN = auto()  # topic
    NO_COMMON_TIME = auto()  # topic, the other
    GAPS = auto()  # topic, how many, s of the longest
    UNCOVERED = auto()  # rows, of how many
    FRAME_TIMES = auto()  # Hz, ms between two
    EPISODES = auto()  # how many, s between two
    MIDDLE_ZERO = auto()
    BEHIND_GEARS = auto()
    MISSING = auto()  # rows, column
    DAMAGED = auto()  # file, first byte, bytes


@dataclass(frozen=True)
class Note:
    """One fact, and its numbers or names."""

    reason: Reason
    values: tuple[Any, ...] = ()
