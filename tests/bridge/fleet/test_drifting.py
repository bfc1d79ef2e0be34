"""Drifts and outliers are found, and scatter alone is not reported as one."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.fleet.drift import (
    DAY,
    Series,
    median_outliers,
    session_times,
    significant_drifts,
)

SESSIONS = 6


def series(
    rng: np.random.Generator, slope: float = 0.0, arm: str = "a", more: float = 3.0
) -> Series:
    """Return values with 1 sigma of 1 whose stated std is 1 / ``more``."""
    at = np.arange(SESSIONS, dtype=float)
    value = 10 + slope * at + rng.normal(0, 1, SESSIONS)
    std = np.full(SESSIONS, 1 / more)
    return Series(arm, "x", "m", "group", at, "session", value, std, ("s",) * SESSIONS)


def test_scatter_alone_is_no_drift_though_its_sigma_is_understated() -> None:
    rng = np.random.default_rng(0)
    fleets = [significant_drifts([series(rng, arm=str(i)) for i in range(60)]) for _ in range(20)]
    assert sum(bool(f) for f in fleets) <= 4


def test_a_drift_is_found_with_its_size_among_arms_that_only_scatter() -> None:
    rng = np.random.default_rng(1)
    fleet = [series(rng, arm=str(i)) for i in range(60)]
    found = significant_drifts([*fleet, series(rng, slope=2.0, arm="moving")])
    assert [d.arm for d in found] == ["moving"]
    assert abs(found[0].slope - 2.0) < 3 * found[0].std
    assert abs(found[0].change - 10.0) < 15 * found[0].std


def test_two_sessions_show_no_drift() -> None:
    at = np.array([0.0, 1.0])
    two = Series("a", "x", "m", "g", at, "session", at * 100, np.ones(2), ("s", "t"))
    assert significant_drifts([two]) == []


def test_session_times_are_days_if_all_have_a_date() -> None:
    times, per = session_times([1.7e9, 1.7e9 + DAY, 1.7e9 + 3 * DAY])
    assert per == "day"
    assert times.tolist() == [0.0, 1.0, 3.0]
    times, per = session_times([1.7e9, None, 1.7e9 + DAY])
    assert per == "session"
    assert times.tolist() == [0.0, 1.0, 2.0]


def test_a_value_far_from_the_median_is_reported_with_the_usual_one() -> None:
    values = [*np.random.default_rng(2).lognormal(0, 0.2, 40), 9.0]
    [(index, usual, deviations)] = median_outliers(values, ratios=True)
    assert index == 40
    assert 0.8 < usual < 1.25
    assert deviations > 4


def test_few_or_equal_values_have_no_outliers() -> None:
    assert median_outliers([1.0, 1.0, 1.0, 50.0], ratios=False) == []
    assert median_outliers([1.0] * 20 + [50.0], ratios=False) == []


def test_a_value_that_its_own_sigma_explains_is_no_outlier() -> None:
    values = [*np.random.default_rng(2).normal(3e-6, 1e-7, 11), 2e-6]
    assert [i for i, _, _ in median_outliers(values, ratios=False)] == [11]
    assert median_outliers(values, ratios=False, stds=[1e-7] * 11 + [4e-7]) == []
    sure = median_outliers(values, ratios=False, stds=[None] * 11 + [1e-7])
    assert [i for i, _, _ in sure] == [11]
