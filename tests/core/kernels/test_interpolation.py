"""Delay, lag and play of a command, against closed forms and scipy's own simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import lsim

from gapbridge.core.kernels.interpolation import interpolate, lagged, played, splined

T = np.arange(2000) * 1e-3


def test_between_samples_a_smooth_signal_is_read_far_better_than_by_straight_lines() -> None:
    time = np.arange(100) * 0.01
    at = time[5:-5] + 0.0047
    truth = np.sin(20.0 * at)
    found = interpolate(time, np.sin(20.0 * time), at)
    straight = np.interp(at, time, np.sin(20.0 * time))
    assert np.abs(found - truth).max() < 0.02 * np.abs(straight - truth).max()
    np.testing.assert_array_equal(interpolate(time, truth[:1].repeat(100), [-1.0, 9.0]), truth[0])


@pytest.mark.parametrize("constant", [0.003, 0.05, 0.7])
def test_a_lag_is_the_response_that_scipy_simulates(constant: float) -> None:
    command = 0.3 * np.sin(5.0 * T) + 0.05 * np.cos(31.0 * T)
    command[1000:] += 0.1
    _, expected, _ = lsim(([1.0], [constant, 1.0]), command, T, X0=[0.2 * constant])
    assert expected[0] == pytest.approx(0.2)
    np.testing.assert_allclose(lagged(T, command, constant, 0.2), expected, atol=1e-9)


def test_a_ramp_is_followed_by_the_time_constant() -> None:
    late = lagged(T, 0.5 * T, 0.04, 0.0)
    assert late[-1] == pytest.approx(0.5 * (T[-1] - 0.04), abs=1e-9)
    np.testing.assert_array_equal(lagged(T, T, 0.0, 0.0), T)


def test_play_stands_still_within_its_width_and_is_pushed_at_both_ends() -> None:
    command = np.concatenate([np.linspace(0, 1, 101), np.linspace(1, -1, 201)[1:]])
    found = played(command, 0.1, 0.0)
    np.testing.assert_allclose(found[:11], 0.0, atol=1e-12)  # the play is taken up first
    np.testing.assert_allclose(found[10:101], command[10:101] - 0.1, atol=1e-12)
    np.testing.assert_allclose(found[101:121], 0.9, atol=1e-12)  # and again at the turn
    np.testing.assert_allclose(found[121:], command[121:] + 0.1, atol=1e-12)
    np.testing.assert_array_equal(played(command, 0.0, 0.0), command)


@pytest.mark.parametrize("count", [4, 5, 500])
def test_a_spline_is_that_of_scipy(count: int) -> None:
    rng = np.random.default_rng(count)
    time = np.cumsum(rng.uniform(1e-3, 4e-3, count))
    value = rng.normal(size=count)
    beyond = 0.01 * (time[-1] - time[0])  # the end cubics go on there
    at = rng.uniform(time[0] - beyond, time[-1] + beyond, 1000)
    at = np.concatenate([at, time, np.sort(at)])
    expected = CubicSpline(time, value)(at)
    assert np.abs(splined(time, value, at) - expected).max() < 1e-12 * np.abs(expected).max()


def test_columns_of_a_table_are_read_where_they_lie() -> None:
    time = np.linspace(0.0, 1.0, 50)
    table = np.stack([time**3, time], axis=1)
    assert np.allclose(splined(time, table[:, 0], time[:-1] + 0.01), (time[:-1] + 0.01) ** 3)
