"""The tracking channel on commands delayed and lagged in closed form."""

from __future__ import annotations

import moving_truth as truth
import numpy as np
import pytest

from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.channels.tracking import encoder_step, observe
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.observation import NotObservable
from gapbridge.core.effects import Site, Term
from gapbridge.core.loads import Loads
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

METROLOGY = Metrology()
N = 6
MODEL = Model(builtin_arm("ur5e"))
COURSE = truth.course(N, 4)
ENCODER = 2 * np.pi / 2**19  # rad


def log_of(actual, target, t, noise=1e-5):
    rng = np.random.default_rng(0)
    noisy = actual + rng.normal(0, noise, actual.shape)
    coded = np.round(noisy / ENCODER) * ENCODER
    return truth.log_of(N, timestamp=t, actual_q=coded, target_q=target)


def times(rate, seconds=20):
    return np.arange(int(rate * seconds)) / rate


@pytest.mark.parametrize("rate", [500, 125, 25])
def test_a_latency_of_all_joints_is_recovered_joint_by_joint(rate):
    t = times(rate)
    log = log_of(COURSE.at(t - 0.0123), COURSE.at(t), t)
    seen = observe(MODEL, log, METROLOGY)
    terms = [Term("latency", Site(j + 1), (0.0,)) for j in range(N)]
    found, spread = truth.fit(MODEL.arm, seen, terms)
    values = np.array([term.values[0] for term in found])
    assert np.abs((values - 0.0123) / spread).max() < 4
    assert spread.max() < 1e-4
    assert (seen.measured - seen.predict(found)).std() < 1.3e-5


@pytest.mark.parametrize("rate", [500, 125, 25])
def test_lag_and_latency_are_separated_on_one_joint(rate):
    t = times(rate)
    lag = 0.02 * (np.arange(N) == 1)
    log = log_of(COURSE.lagged(t - 0.008, lag), COURSE.at(t), t)
    seen = observe(MODEL, log, METROLOGY)
    terms = [Term("tracking_lag", Site(2), (0.0,))]
    terms += [Term("latency", Site(j + 1), (0.0,)) for j in range(N)]
    found, spread = truth.fit(MODEL.arm, seen, terms)
    values = np.array([term.values[0] for term in found])
    assert np.abs((values - np.array([0.02] + [0.008] * N)) / spread).max() < 4
    assert (seen.measured - seen.predict(found)).std() < 1.3e-5


def test_a_lag_is_no_latency():
    t = times(500)
    log = log_of(COURSE.lagged(t, np.full(N, 0.02)), COURSE.at(t), t)
    seen = observe(MODEL, log, METROLOGY)
    residual = []
    for effect in ("tracking_lag", "latency"):
        terms = [Term(effect, Site(j + 1), (0.0,)) for j in range(N)]
        found, _ = truth.fit(MODEL.arm, seen, terms)
        residual.append((seen.measured - seen.predict(found)).std())
    assert residual[0] < 1.3e-5
    assert residual[1] > 5e-5


def test_slow_motion_gives_only_the_sum_of_lag_and_latency():
    t = times(125)
    slow = truth.Course(COURSE.amplitude, COURSE.frequency * 0.05, COURSE.phase, COURSE.centre)
    log = log_of(slow.at(t - 0.01), slow.at(t), t)
    seen = observe(MODEL, log, METROLOGY)
    columns = []
    for effect in ("tracking_lag", "latency"):
        up, down = (seen.predict([Term(effect, Site(1), (h,))]) for h in (5e-5, -5e-5))
        columns.append((up - down)[:, 0])
    a, b = columns
    assert abs(a @ b) / np.linalg.norm(a) / np.linalg.norm(b) > 0.9999


def test_the_start_whose_past_is_unknown_is_left_out():
    t = times(500)
    log = log_of(COURSE.at(t - 0.1), COURSE.at(t), t)
    seen = observe(MODEL, log, METROLOGY)
    assert seen.rows[0] >= 150
    term = Term("latency", Site(1), (0.1,))
    assert np.abs(seen.measured - seen.predict([term]))[:, 0].max() < 1e-4


def test_the_encoders_step_is_the_known_noise():
    t = times(500)
    seen = observe(MODEL, log_of(COURSE.at(t), COURSE.at(t), t, noise=0), METROLOGY)
    assert seen.sigma == pytest.approx(ENCODER / np.sqrt(12), rel=0.05)
    assert encoder_step(COURSE.at(t) + np.random.default_rng(0).normal(0, 1e-4, (len(t), N))) == 0


def test_poses_at_rest_are_observed_without_delays():
    q = truth.poses(N, 30, 0)
    log = truth.log_of(N, timestamp=np.arange(30) * 20.0, actual_q=q + 1e-5, target_q=q)
    seen = observe(MODEL, log, METROLOGY)
    assert np.array_equal(seen.predict([Term("latency", Site(1), (0.1,))]), seen.predict(()))
    assert len(seen.measured) == 30


def test_what_is_missing_is_named():
    q = np.zeros((30, N))
    assert observe(MODEL, truth.log_of(N, actual_q=q), METROLOGY) == NotObservable(
        "tracking", ("target_q",)
    )


@pytest.mark.parametrize("effect", ["latency", "tracking_lag"])
def test_a_delay_is_not_taken_for_a_lag_nor_a_lag_for_a_delay(effect):
    """To first order they are the same, so that a search by slopes alone stays with either."""
    t, sway, late = np.arange(0, 20, 0.02), 0.6, 0.015
    phase = np.linspace(0, 2, N)
    target = 0.5 * np.sin(sway * t[:, None] + phase)
    actual = target.copy()
    if effect == "latency":
        actual[:, 2] = 0.5 * np.sin(sway * (t - late) + phase[2])
    else:
        shrunk, behind = np.hypot(1, sway * late), np.arctan(sway * late)
        actual[:, 2] = 0.5 / shrunk * np.sin(sway * t + phase[2] - behind)
    actual += np.random.default_rng(5).normal(0, 2e-5, actual.shape)
    found = diagnose(MODEL, truth.log_of(N, timestamp=t, actual_q=actual, target_q=target))
    (cause,) = found.channels[0].causes
    assert (cause.effect, cause.joints, cause.indistinguishable_from) == (effect, (3,), ())
    assert found.verdict == "explained"
    assert cause.parameters[0].value == pytest.approx(late, rel=0.01)


def test_the_one_delay_of_a_controller_holds_at_a_joint_that_another_shakes():
    """Joint 6 swings as joint 3 accelerates, thirty times as far as a delay of its own differs."""
    t = times(125)
    actual = COURSE.at(t - 0.012)
    shaken = COURSE.at(t, 2)[:, 2] * np.cos(2 * COURSE.at(t)[:, 5])
    actual[:, 5] += 0.02 * shaken / shaken.std()
    found = diagnose(MODEL, log_of(actual, COURSE.at(t), t), METROLOGY)
    (channel,) = [c for c in found.channels if c.channel == "tracking"]
    (cause,) = channel.causes
    assert (cause.effect, cause.joints) == ("latency", (1, 2, 3, 4, 5, 6))
    value = {p.name: (p.value, p.std) for p in cause.parameters}
    assert value["latency_6"][0] == pytest.approx(0.012, rel=0.1)
    assert value["latency_6"][1] > 100 * value["latency_1"][1]
    assert cause.indistinguishable_from == ()
    assert channel.structured


def test_delays_that_differ_are_each_joints_own():
    t = times(125)
    late = np.array([0.004, 0.009, 0.014, 0.02, 0.027, 0.035])
    actual = np.column_stack([COURSE.at(t - late[j])[:, j] for j in range(N)])
    found = diagnose(MODEL, log_of(actual, COURSE.at(t), t), METROLOGY)
    (channel,) = [c for c in found.channels if c.channel == "tracking"]
    (cause,) = channel.causes
    assert [p.value for p in cause.parameters] == pytest.approx(list(late), rel=1e-2)


def drooping(t, joint, droop):
    """Return where servos stand (N, n) of which one gives way to what it holds."""
    target = COURSE.at(t)
    held = MODEL.holding_torque(target, Loads())
    actual = target.copy()
    actual[:, joint - 1] -= droop * held[:, joint - 1]
    return actual


def test_a_droop_is_accused_besides_an_unknown_function_of_the_joints_own_speed():
    """It is more than the delay that it holds at first order."""
    t = times(125)
    actual, speed = drooping(t, 3, 1e-3), COURSE.at(t, 1)[:, 2]
    lost = np.maximum(speed - 0.3 * speed.max(), 0) ** 2
    actual[:, 2] -= 2e-3 * lost / lost.std()
    found = diagnose(MODEL, log_of(actual, COURSE.at(t), t), METROLOGY)
    (channel,) = [c for c in found.channels if c.channel == "tracking"]
    value = {p.name: p.value for c in channel.causes for p in c.parameters}
    assert value["servo_droop_3"] == pytest.approx(1e-3, rel=0.05)
    assert channel.structured


def test_what_no_encoder_resolves_is_no_gap():
    q = np.random.default_rng(3).uniform(-2.0, 2.0, (30, N))
    for off, structured in ((4e-9, False), (4e-5, True)):
        log = truth.log_of(N, target_q=q, actual_q=q + off * np.sin(2 * q))
        (channel,) = diagnose(MODEL, log, METROLOGY).channels
        assert channel.structured == structured
        assert (channel.verdict == "no_gap") != structured


@pytest.mark.parametrize("delay", [0.0, 0.01])
def test_joints_at_rest_depend_on_nothing_beside_joints_that_move(delay):
    """A joint at rest reads its encoder's noise alone, on which its own residual would depend."""
    t = times(50)
    target, actual = COURSE.at(t), COURSE.at(t)
    actual[:, 0] = COURSE.at(t - delay)[:, 0]
    target[:, 3:] = actual[:, 3:] = target[0, 3:]
    (channel,) = diagnose(MODEL, log_of(actual, target, t, noise=5e-5)).channels
    assert not channel.structured
    named = [(cause.effect, cause.joints) for cause in channel.causes]
    assert named == ([("latency", (1,))] if delay else [])
