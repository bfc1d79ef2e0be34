"""A stop reads the same whatever the controller; a sample is checked by one set of limits."""

from __future__ import annotations

import numpy as np
import pytest

from gapbridge.core.arm import builtin_arm
from gapbridge.drivers.robot_modes import MODES, modes_of
from gapbridge.drivers.simulated.ur.modes import SAFETY_BITS
from gapbridge.drivers.state_check import BEYOND, FASTEST, JITTER, JointCheck

ARM = builtin_arm("ur10e")


@pytest.mark.parametrize("trouble", ["", "protective_stop", "emergency_stop"])
def test_every_driver_reports_a_stop_as_a_ur_controller_does(trouble: str) -> None:
    modes = modes_of([trouble])
    assert modes == MODES[trouble]
    assert modes.safety_status_bits == SAFETY_BITS[modes.safety_mode]


def test_of_several_troubles_the_gravest_counts_and_no_bit_is_lost() -> None:
    both = modes_of(["not_ready", "protective_stop", "fault"])
    assert (both.robot_mode, both.safety_mode) == (5, 9)
    assert both.safety_status_bits == 1 << 2 | 1 << 9 | 1 << 10
    assert modes_of([]) == MODES[""]


@pytest.mark.parametrize("angle", [np.nan, np.inf, -np.inf, 2 * np.pi + 2 * BEYOND])
def test_an_angle_that_no_such_arm_has_is_named(angle: float) -> None:
    q = np.zeros(6)
    check = JointCheck(ARM)
    assert check.outside(q) is None
    q[3] = angle
    assert "joint 4" in str(check.outside(q))


def test_a_step_that_no_joint_makes_is_named() -> None:
    check, step = JointCheck(ARM), np.zeros(6)
    step[1] = -0.9 * (FASTEST * 0.01 + JITTER)
    assert check.jumped(step, 0.01) is None
    step[1] *= 1.2
    assert "joint 2: found a step" in str(check.jumped(step, 0.01))
