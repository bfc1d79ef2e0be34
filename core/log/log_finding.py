"""What is odd about a log, or suspected of it: a kind and its values; ``bridge`` words them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Union


class LogCheck(Enum):
    """What a check of a log found; the comment lists the finding's values."""

    # the file
    MISSPELT = auto()  # column found, column that may be meant
    CLOCKS_OVERLAP = auto()
    COPIED_ROWS = auto()  # rows that repeat the timestamp before, all rows, line of the first
    ROUNDED_TIME = auto()  # grain (s), rows that repeat, line of the first
    AMBIGUOUS_TIME = auto()  # line of the first, its time (s), rows that repeat, all rows
    REPEATED_TIME = auto()  # rows
    BACKWARD_TIME = auto()  # rows, line of the first
    WHOLE_TURNS = auto()  # joints
    WRONG_SPEEDS = auto()  # joints, the speeds over those of the angles
    NO_READING = auto()  # rows, column
    POSITIONS_AT_REST = auto()
    FAHRENHEIT = auto()
    FEW_POSES = auto()  # poses
    # against the cell's arm
    BEYOND_LIMITS = auto()  # joints
    BEYOND_SESSIONS = auto()  # session, columns
    BEYOND_FITTED = auto()  # columns, rows, all rows, least, largest, unit, line, value
    NOT_IN_BASE = auto()  # median distance (m)
    POSITIONS_OFF = auto()  # median distance (m)
    POSITIONS_OFF_BY = auto()  # median distance (m), the mistake, distance without it (m)
    ROTATIONS_OFF = auto()  # median angle (rad)
    ROLL_PITCH_YAW = auto()
    TARGET_AXES = auto()  # angle (rad)
    TARGET_REMOUNTED = auto()
    # mistakes that would explain positions that are far off
    MIRRORED = auto()
    INVERTED = auto()
    JOINT_SIGN = auto()  # joint
    ROW_LATE = auto()
    ROW_EARLY = auto()
    LENGTH_UNIT = auto()  # unit
    OTHER_ARM = auto()  # name of a built-in arm
    FLANGE_NOT_TCP = auto()
    TCP_SIGN = auto()
    MODIFIED_DH = auto()
    DH_SIGN = auto()  # key of the DH rows
    DH_UNIT = auto()  # unit
    NO_TCP = auto()  # the measured point in the flange's frame (m)
    OTHER_TCP = auto()  # the measured point in the flange's frame (m), tool.tcp (m)
    JOINTS_SWAPPED = auto()  # two joints
    UR_JOINTS_SWAPPED = auto()  # elbow and shoulder pan, as sorted by name: two joints
    JOINTS_REVERSED = auto()
    JOINT_ORDER = auto()  # (joint, index of its column) of those out of place
    COMMAND_ORDER = auto()  # the same of target_q
    # forces
    PULL_SIGN = auto()
    PULL_IN_TOOL = auto()
    PULL_SIGN_IN_TOOL = auto()
    WRENCH_SIGN = auto()
    TORQUES_FIRST = auto()
    LEFT_HANDED_WRENCH = auto()  # axes of the flange that its three forces are along, with signs
    TORQUE_SIGN = auto()
    TORQUE_UNSIGNED = auto()
    WRENCH_LAG = auto()  # how late (s), negative: early
    TORQUE_LAG = auto()  # the same
    CURRENTS = auto()  # share of the weights, joints
    GRAVITY = auto()  # what the torques show, that of the cell (m/s², base axes)
    # the model
    MISSING_FLEXIBILITY = auto()  # flexibilities, gap before and after their fit (m)


OTHER_ARM_CHECKS = (
    LogCheck.NOT_IN_BASE, LogCheck.POSITIONS_OFF, LogCheck.POSITIONS_OFF_BY, LogCheck.ROTATIONS_OFF,
    LogCheck.ROLL_PITCH_YAW, LogCheck.TARGET_AXES, LogCheck.GRAVITY,
)  # fmt: skip
"""The poses, or the weights, are not those of the cell's arm: nothing that is fitted holds."""

MISREAD = {
    LogCheck.WRENCH_SIGN: "wrench", LogCheck.TORQUES_FIRST: "wrench",
    LogCheck.LEFT_HANDED_WRENCH: "wrench", LogCheck.TORQUE_SIGN: "torque",
    LogCheck.TORQUE_UNSIGNED: "torque", LogCheck.CURRENTS: "torque",
    LogCheck.WRENCH_LAG: "wrench", LogCheck.TORQUE_LAG: "torque",
    LogCheck.COMMAND_ORDER: "tracking",
}  # fmt: skip
"""Channels whose readings are not what their column should hold."""

TOOL_CHECKS = (
    LogCheck.FLANGE_NOT_TCP, LogCheck.TCP_SIGN, LogCheck.NO_TCP, LogCheck.OTHER_TCP,
    LogCheck.TARGET_AXES,
)  # fmt: skip
"""The target is at another place of the tool: a fit and a diagnosis estimate it."""

Value = Union[str, int, float, "LogFinding", tuple["Value", ...]]


@dataclass(frozen=True)
class LogFinding:
    """One finding; ``sessions`` names those that it holds for where a log has several."""

    check: LogCheck
    values: tuple[Value, ...] = ()
    sessions: tuple[str, ...] = ()

    @property
    def forbids_fit(self) -> bool:
        """Return whether nothing that is fitted holds: poses or weights are another arm's."""
        causes = [value for value in self.values if isinstance(value, LogFinding)]
        checks = [cause.check for cause in causes] or [self.check]
        return self.check in OTHER_ARM_CHECKS and not any(c in TOOL_CHECKS for c in checks)

    @property
    def misread(self) -> str:
        """Return the channel of which no cause holds, as its readings mean another; "": none."""
        return MISREAD.get(self.check, "")
