"""Robot and safety modes in RTDE's numbers for every controller: one table for all drivers.

Source: Universal Robots, RTDE guide (robot_mode, safety_mode, safety_status_bits): bits 0 normal, 2
protective stop, 6 robot emergency stop, 7 emergency stop, 9 fault, 10 stopped due to safety.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import NamedTuple

from gapbridge.core.state import RobotState

POWER_OFF, IDLE, RUNNING = 3, 5, 7  # robot_mode
NORMAL, REDUCED, PROTECTIVE_STOP, EMERGENCY_STOP, FAULT = 1, 2, 3, 7, 9  # safety_mode
STOPPED = 1 << 10
STOPS = 0b111_1111_1100  # safety_status_bits: all but normal and reduced mode
PROGRAM_STOPPING, PROGRAM_STOPPED, PLAYING, PAUSED = 0, 1, 2, 4  # runtime_state


class StopReason(StrEnum):
    """The reason why a robot cannot move, as profiles name it."""

    NOT_READY = "not_ready"
    PROTECTIVE_STOP = "protective_stop"
    EMERGENCY_STOP = "emergency_stop"
    FAULT = "fault"


class Modes(NamedTuple):
    """The three numbers of a RobotState that say whether the robot may move."""

    robot_mode: int
    safety_mode: int
    safety_status_bits: int


MODES: dict[StopReason | None, Modes] = {
    None: Modes(RUNNING, NORMAL, 1),
    StopReason.NOT_READY: Modes(IDLE, NORMAL, 1),
    StopReason.PROTECTIVE_STOP: Modes(RUNNING, PROTECTIVE_STOP, 1 << 2 | STOPPED),
    StopReason.EMERGENCY_STOP: Modes(POWER_OFF, EMERGENCY_STOP, 1 << 6 | 1 << 7 | STOPPED),
    StopReason.FAULT: Modes(RUNNING, FAULT, 1 << 9 | STOPPED),
}
"""A stop reason -> what every driver reports; None: the robot may move."""


def why_not_ready(state: RobotState) -> str:
    """Return why the robot cannot move, as text; empty where it can."""
    stops = state.safety_status_bits & STOPS
    if state.robot_mode == RUNNING and state.safety_mode in (NORMAL, REDUCED) and not stops:
        return ""
    detail = f"robot_mode {state.robot_mode}, safety_mode {state.safety_mode}"
    return f"{detail}, safety_status_bits {state.safety_status_bits:#b}" if stops else detail


def modes_of(stop_reasons: Iterable[StopReason | None]) -> Modes:
    """Return the combined modes of ``stop_reasons``: the most severe of each, all bits."""
    combined = MODES[None]
    for reason in stop_reasons:
        mode = MODES[reason]
        bits = combined.safety_status_bits | mode.safety_status_bits
        combined = Modes(
            min(combined.robot_mode, mode.robot_mode),
            max(combined.safety_mode, mode.safety_mode),
            bits & ~1 if bits & STOPPED else bits,
        )
    return combined
