"""Setpoints that do not come on time: the arm goes on smoothly."""

from __future__ import annotations

import numpy as np
import pytest
from clock_by_hand import ByHand

from gapbridge.bridge.setpoint_source.interpolator import MAX_INTERVAL, SetpointInterpolator

CYCLE = 0.002
SPEED = 0.5  # rad/s of the planner


def speeds(arrivals: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the speed of each cycle, of setpoints that arrive at ``arrivals`` (s) on the way."""
    clock = ByHand()
    begun, taken, sampled = clock.now, 0, []
    interpolator = SetpointInterpolator(1.0, "line", 1.0 / CYCLE, clock)
    for cycle in range(int(arrivals[-1] / CYCLE)):
        clock.now = begun + cycle * CYCLE
        new = taken
        while taken < len(arrivals) and arrivals[taken] <= cycle * CYCLE + 1e-9:
            interpolator.take(SPEED * wanted[taken : taken + 1])
            taken += 1
        if not sampled:
            interpolator.begin(SPEED * wanted[:1])
        elif new != taken:
            interpolator.restart()
        sampled.append(interpolator.sample()[0])
    return np.diff(sampled) / CYCLE


@pytest.mark.parametrize("late", [0.0, 0.004, 0.006, 0.008, 0.009, 0.025])
def test_one_late_line_is_caught_up_at_less_than_twice_the_planners_speed(late: float) -> None:
    """As are those that come in one packet with it."""
    wanted = 0.01 * np.arange(60)
    arrivals = wanted.copy()
    arrivals[30] += late
    found = speeds(np.maximum.accumulate(arrivals), wanted)
    assert found.max() <= (2.0 if late else 1.0 + 1e-9) * SPEED
    assert found.min() >= 0.0
    assert found[-20:] == pytest.approx(SPEED, rel=1e-3)  # and it lags no more than before


@pytest.mark.parametrize(("before", "after"), [(0.01, 0.002), (0.08, 0.004), (MAX_INTERVAL, 0.002)])
def test_a_planner_that_becomes_faster_is_caught_up_with_smoothly(
    before: float, after: float
) -> None:
    slow = before * np.arange(10)
    wanted = np.concatenate([slow, slow[-1] + after * np.arange(1, 400)])
    found = speeds(wanted, wanted)
    assert found.max() <= 2.0 * SPEED * (1.0 + 1e-9)
    assert found[-20:] == pytest.approx(SPEED)


@pytest.mark.parametrize("cycles", [1, 2, 5])
def test_the_arm_never_stands_between_lines_that_come_on_time(cycles: int) -> None:
    """One line per cycle, two cycles or five: with the planner's speed, a line or two behind it."""
    wanted = cycles * CYCLE * np.arange(100)
    found = speeds(wanted, wanted)
    assert found[20:] == pytest.approx(SPEED, rel=1e-2)
    behind = wanted[-1] - found.sum() * CYCLE / SPEED
    assert behind < (cycles + 2.5) * CYCLE


def test_lines_in_packets_move_the_arm_as_evenly_as_lines_on_time() -> None:
    wanted = 0.004 * np.arange(200)
    arrivals = 0.04 * np.ceil(wanted / 0.04 - 1e-9)
    found = speeds(arrivals, wanted)
    assert found[60:] == pytest.approx(SPEED, rel=1e-2)


@pytest.mark.parametrize("late", [0.0, 0.00005, 2 * CYCLE])
def test_the_way_from_the_arm_to_the_first_setpoint_is_left_to_the_lead_in(late: float) -> None:
    """Also where a second line has come before the first cycle, or that cycle was late."""
    clock = ByHand()
    interpolator = SetpointInterpolator(1.0, "line", 1.0 / CYCLE, clock)
    arm, there = np.zeros(1), np.full(1, 0.019)
    interpolator.take(there)
    interpolator.begin(arm)
    clock.now += late
    if late:
        interpolator.take(there)
        interpolator.restart()
    assert interpolator.sample() == pytest.approx(there)
