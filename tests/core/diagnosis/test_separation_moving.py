"""What to record next: motions that separate what a slow recording leaves open."""

from __future__ import annotations

from dataclasses import replace

import moving_truth as truth
import numpy as np
import pytest

from gapbridge.bridge.document.diagnosis_json import document
from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.separation import LEAD, POSES, draw_trials
from gapbridge.core.model import Model
from gapbridge.core.workspace.workspace import Workspace

N = 6
MODEL = Model(builtin_arm("ur5e"))
DELAY = 0.015  # s
SLOW = 0.2  # rad/s of the sway


@pytest.fixture(scope="module")
def slow():
    """A recording so slow and short of rows that a delayed joint and a lagging one look alike."""
    return recorded(0.066)


def recorded(step: float):
    t = np.arange(0, 20, step)
    phase = np.linspace(0, 2, N)

    def at(time):
        return 0.5 * np.sin(SLOW * time[:, None] + phase)

    late = at(t)
    late[:, 2] = at(t - DELAY)[:, 2]
    late += np.random.default_rng(5).normal(0, 2e-5, late.shape)
    return diagnose(MODEL, truth.log_of(N, timestamp=t, actual_q=late, target_q=at(t)))


def test_a_delay_or_a_lag_in_slow_motion_is_reported_as_a_tie(slow):
    (cause,) = slow.channels[0].causes
    assert {cause.effect, *cause.indistinguishable_from} == {"latency", "tracking_lag"}
    assert cause.joints == (3,)


def test_rows_enough_decide_what_few_of_them_leave_open():
    """The search looks at 300 of these 1,000 rows, on which the two are a tie as above."""
    (cause,) = recorded(0.02).channels[0].causes
    assert (cause.effect, cause.joints, cause.indistinguishable_from) == ("latency", (3,), ())


def test_a_proposed_motion_is_feasible_and_faster_than_the_recording(slow):
    requested = [m for m in slow.next_measurements if len(m.separates) == 2]
    assert requested
    for reported in requested:
        assert np.all(np.abs(reported.velocity) <= MODEL.arm.limits.velocity)
        began = np.array(reported.velocity) - 0.5 * np.array(reported.acceleration)
        assert np.all(np.abs(began) <= MODEL.arm.limits.velocity * 1.000001)
        assert (
            abs(reported.acceleration[2]) > 3 * 0.5 * SLOW**2
        )  # the recording's own hardest, thrice
        assert reported.expected_gain > 1


def test_the_expected_gain_is_what_the_two_explanations_come_to_there(slow):
    """To second order a lag T runs T**2 qdd / 2 off a delay of the same T."""
    requested = next(m for m in slow.next_measurements if len(m.separates) == 2)
    floor = slow.channels[0].noise_floor_rms
    assert requested.expected_gain == pytest.approx(
        0.5 * DELAY**2 * abs(requested.acceleration[2]) / floor, rel=0.25
    )


def test_speed_and_acceleration_are_in_the_document(slow):
    reported = [m for m in document(slow)["next_measurements"] if len(m["separates"]) == 2]
    assert reported
    assert all(len(m["velocity"]) == len(m["acceleration"]) == N for m in reported)


@pytest.mark.parametrize("name", ["ur5e", "ur10e"])
@pytest.mark.parametrize("margin", [None, 0.8])
def test_trials_keep_within_the_limits_and_clear_of_the_arm_itself(name, margin):
    """Without the check every second pose of a UR5e meets the arm itself.

    ``margin`` (rad): half the range of a joint, as that of a short wrist; the way of half a second
    is longer.
    """
    model = Model(builtin_arm(name))
    if margin is not None:
        limits = replace(model.arm.limits, lower=np.full(N, -margin), upper=np.full(N, margin))
        model = replace(model, arm=replace(model.arm, limits=limits))
    limits = model.arm.limits
    trials = draw_trials(model, truth.log_of(N, actual_q=np.zeros((2, N))), 3)
    assert len(trials.q) == POSES
    space = Workspace.of(model)
    for time in np.linspace(-LEAD, 0.0, 20):
        way = trials.q + trials.qd * time + 0.5 * trials.qdd * time**2
        assert np.all((limits.lower - 1e-4 <= way) & (way <= limits.upper + 1e-4))
        if time in (-LEAD, 0.0):
            assert space.clear(np.clip(way, space.lower, space.upper)).all()
    assert np.median(np.abs(trials.qd)) > 0.1  # they still move
    braked = trials.q + 0.5 * trials.qd * np.abs(trials.qd) * 0.25 / limits.velocity
    assert np.all((limits.lower - 1e-9 <= braked) & (braked <= limits.upper + 1e-9))
