"""A stop reads the same whatever the controller; a sample is checked by one set of limits."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import Implausible, InvalidStateError, WriteError
from gapbridge.core.state import RobotState
from gapbridge.drivers.robot_modes import MODES, StopReason, modes_of, why_not_ready
from gapbridge.drivers.simulated.ur.modes import SAFETY_BITS
from gapbridge.drivers.state_check import (
    FASTEST,
    JITTER,
    LIMIT_MARGIN,
    VELOCITY_FACTOR,
    SampleCheck,
)
from gapbridge.drivers.ur_rtde.command import check_ready

ARM = builtin_arm("ur10e")


@pytest.mark.parametrize("reason", [None, StopReason.PROTECTIVE_STOP, StopReason.EMERGENCY_STOP])
def test_every_driver_reports_a_stop_as_a_ur_controller_does(
    reason: StopReason | None,
) -> None:
    modes = modes_of([reason])
    assert modes == MODES[reason]
    assert modes.safety_status_bits == SAFETY_BITS[modes.safety_mode]


def test_of_several_stops_the_gravest_counts_and_no_bit_is_lost() -> None:
    both = modes_of([StopReason.NOT_READY, StopReason.PROTECTIVE_STOP, StopReason.FAULT])
    assert (both.robot_mode, both.safety_mode) == (5, 9)
    assert both.safety_status_bits == 1 << 2 | 1 << 9 | 1 << 10
    assert modes_of([]) == MODES[None]


@pytest.mark.parametrize("bit", range(11))
def test_a_stop_in_the_safety_bits_alone_keeps_every_driver_from_arming(bit: int) -> None:
    normal = state(np.zeros(6))
    found = normal._replace(safety_status_bits=1 | 1 << bit)
    ready = bit < 2  # normal and reduced mode
    assert bool(why_not_ready(found)) != ready
    with nullcontext() if ready else pytest.raises(WriteError, match="safety_status_bits"):
        check_ready("the robot", found)
    assert "robot_mode 5" in why_not_ready(normal._replace(robot_mode=5))
    assert "safety_mode 9" in why_not_ready(normal._replace(safety_mode=9))


def state(q: np.ndarray, at: float = 0.0) -> RobotState:
    return RobotState(at, at, q, np.zeros(6), q, np.zeros(6))


@pytest.mark.parametrize("angle", [np.nan, np.inf, -np.inf, 2 * np.pi + 2 * LIMIT_MARGIN])
def test_an_angle_that_no_such_arm_has_is_named(angle: float) -> None:
    q = np.zeros(6)
    check = SampleCheck(ARM)
    check.check(state(q))
    with pytest.raises(InvalidStateError, match="actual_q_3: found"):
        check.check(state(np.array([0.0, 0.0, 0.0, angle, 0.0, 0.0]), 1.0))


@pytest.mark.parametrize("at", [np.nan, np.inf, -np.inf, 1e300])
def test_a_time_that_no_clock_shows_is_refused(at: float) -> None:
    """Cycles are counted by it: an infinite one ended the loop with an OverflowError."""
    check, q = SampleCheck(ARM), np.zeros(6)
    check.check(state(q))
    with pytest.raises(InvalidStateError, match="timestamp: found"):
        check.check(state(q, at))
    check.check(state(q, 0.01))


@pytest.mark.parametrize("field", ["joint_temperatures", "actual_current_as_torque", "payload_cog"])
def test_every_vector_that_a_driver_reports_is_checked(field: str) -> None:
    value = np.full(3 if field == "payload_cog" else 6, 0.01)
    check = SampleCheck(ARM)
    check.check(state(np.zeros(6))._replace(**{field: value}))
    value[1] = 2e4
    with pytest.raises(InvalidStateError, match=f"{field}_1: found 20000"):
        check.check(state(np.zeros(6), 1.0)._replace(**{field: value}))
    with pytest.raises(InvalidStateError, match="payload: found -1 kg"):
        check.check(state(np.zeros(6), 1.0)._replace(payload=-1.0))


@pytest.mark.parametrize("fastest", [0.5, FASTEST])
def test_a_step_that_no_joint_makes_is_named(fastest: float) -> None:
    check, q = SampleCheck(ARM, fastest), np.zeros(6)
    check.check(state(q))
    q[1] = -0.9 * (min(VELOCITY_FACTOR * ARM.limits.velocity[1], fastest) * 0.01 + JITTER)
    check.check(state(q, 0.01))
    check.reset()
    check.check(state(np.zeros(6)))
    with pytest.raises(InvalidStateError, match="actual_q_1: found a step") as caught:
        check.check(state(1.2 * q, 0.01))
    assert caught.value.reason == Implausible.STEP
