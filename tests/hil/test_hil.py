"""The driver contract against real hardware; it only reads, unless motion is allowed."""

from __future__ import annotations

import time

import numpy as np
import pytest
from contract_checks import (
    check_closed,
    check_not_armed,
    check_reads,
    next_state,
    setpoint_of,
    stream,
)

from gapbridge.bridge.cell import Cell
from gapbridge.core.errors import WriteError
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.driver import Driver

SHIFT = 2e-4  # m, along base z
TURN = np.radians(0.5)  # of the last joint
PACE = np.radians(1.0)  # per s
COARSE = 2e-3  # rad: joints at rest report the same angle within this


def test_states_are_complete_and_time_goes_on(cell: Cell, driver: Driver) -> None:
    check_reads(driver, cell.model, 50)


def test_the_arm_at_rest_shows_the_same_joints_again(driver: Driver) -> None:
    states = [next_state(driver) for _ in range(50)]
    speed = np.abs([s.actual_qd for s in states]).max()
    if speed > 0.01:
        pytest.skip(f"the arm moves at {speed:.3f} rad/s")
    spread = np.ptp([s.actual_q for s in states], axis=0)
    assert (spread < COARSE).all()


def test_without_arming_nothing_leaves(driver: Driver) -> None:
    check_not_armed(driver)


def test_a_closed_driver_reads_nothing(driver: Driver) -> None:
    next_state(driver)
    check_closed(driver)


def test_a_driver_connects_a_second_time(cell: Cell, driver: Driver) -> None:
    driver.close()
    driver.connect()
    check_reads(driver, cell.model, 5)


def test_what_is_written_moves_the_arm(cell: Cell, driver: Driver, motion: None) -> None:
    state = next_state(driver)
    try:
        driver.arm(state)
    except WriteError as error:
        pytest.skip(f"this link does not write: {error}")
    (_joint_turns if driver.moves_arm else _offset_comes_back)(cell, driver)


def _joint_turns(cell: Cell, driver: Driver) -> None:
    """The last joint turns by half a degree and back."""
    start = next_state(driver).actual_q.copy()
    limits = cell.model.arm.limits
    way = np.zeros(driver.n)
    way[-1] = TURN if start[-1] + TURN < limits.upper[-1] else -TURN
    try:
        for begin, end in ((start, start + way), (start + way, start)):
            begun = time.monotonic()

            def ramp(state: RobotState, _: np.ndarray, a=begin, b=end, t=begun) -> Setpoint:
                share = min((time.monotonic() - t) * PACE / TURN, 1.0)
                return setpoint_of(state, a + share * (b - a), a, (0.0,) * 6)

            stream(driver, ramp, 3.0)
            assert np.abs(next_state(driver).actual_q - end).max() < TURN / 5.0
    finally:
        driver.release()


def _offset_comes_back(cell: Cell, driver: Driver) -> None:
    """An offset is taken by the robot's program, and the arm's own path stays what it was."""
    own = driver.nominal_q(next_state(driver)).copy()
    offset = (0.0, 0.0, SHIFT, 0.0, 0.0, 0.0)
    try:
        stream(driver, lambda state, q: setpoint_of(state, q, q, offset), 2.0)
        assert np.abs(driver.nominal_q(next_state(driver)) - own).max() < COARSE
    finally:
        driver.release()
