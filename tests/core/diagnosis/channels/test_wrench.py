"""The wrench channel on Pinocchio's flange wrenches, at rest and moving."""

from __future__ import annotations

from dataclasses import replace

import moving_truth as truth
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapbridge.core.diagnosis.channels.wrench import observe, torque_weight
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.finding import ChannelFinding, Check, NotAccused
from gapbridge.core.diagnosis.observation import NotObservable, Observation
from gapbridge.core.effects import Site, Term
from gapbridge.core.metrology import Metrology
from gapbridge.core.sessions import join_sessions, with_sessions

METROLOGY = Metrology()
N, ROWS = 7, 70
NOISE = np.repeat([0.3, 0.01], 3)  # N, Nm
TURN = np.array([0.02, -0.03, 0.05])  # rad
BIAS = np.array([1, -2, 3, 0.1, 0.2, -0.1])
GAIN = np.array([0.02, -0.01, 0.03, 0.02, 0.01, -0.03])


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    return truth.plant(tmp_path_factory.mktemp("arm"), N, 1)


@pytest.fixture(scope="module")
def session(plant):
    rng = np.random.default_rng(5)
    q, mass = truth.poses(N, ROWS, 5), rng.choice([2.0, 4.0], ROWS)
    pull = np.zeros((ROWS, 6))
    pull[::3] = rng.normal(0, 10, pull[::3].shape) * [1, 1, 1, 0.1, 0.1, 0.1]
    return q, mass, pull, plant.dynamics(q, 0 * q, 0 * q, pull, mass)[1]


def log_of(session, wrench, seed=0):
    q, mass, pull, _ = session
    noise = np.random.default_rng(seed).normal(0, 1, wrench.shape) * NOISE
    return truth.log_of(
        N, timestamp=np.arange(ROWS) * 20.0, actual_q=q, payload=mass,
        payload_cog=np.tile(truth.COG, (ROWS, 1)), actual_TCP_force=pull,
        ft_raw_wrench=wrench + noise,
    )  # fmt: skip


def truth_of(plant, session, effect):
    """Return the reading with an effect, and its parameters."""
    q, mass, pull, wrench = session
    if effect == "payload":
        return plant.dynamics(q, 0 * q, 0 * q, pull, mass + 0.4)[1], np.array([0.4])
    if effect == "ft_misalignment":
        sensor = Rotation.from_rotvec(TURN).inv()
        turned = [sensor.apply(wrench[:, :3]), sensor.apply(wrench[:, 3:])]
        return np.hstack(turned), TURN
    if effect == "ft_drift":
        return wrench + np.outer(np.arange(ROWS) * 20.0, BIAS * 1e-3), BIAS * 1e-3
    return (wrench + BIAS, BIAS) if effect == "ft_bias" else (wrench * (1 + GAIN), GAIN)


EFFECTS = ("ft_bias", "ft_drift", "ft_gain", "ft_misalignment", "payload")


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_is_recovered(plant, session, effect):
    reading, expected = truth_of(plant, session, effect)
    scores = []
    for seed in range(5):
        seen = observe(plant.model(), log_of(session, reading, seed), METROLOGY)
        start = Term(effect, Site(), (0.0,) * len(expected))
        (found,), spread = truth.fit(plant.arm, seen, [start])
        scores.append((np.array(found.values) - expected) / spread)
    assert np.abs(scores).max() < 4.5
    assert np.sqrt(np.mean(np.square(scores))) < 1.5
    residual = (seen.measured - seen.predict([found])) / NOISE
    assert residual.std() == pytest.approx(1, abs=0.12)


def test_a_clean_session_leaves_the_noise_with_comparable_axes(plant, session):
    seen = observe(plant.model(), log_of(session, session[3]), METROLOGY)
    residual = (seen.measured - seen.predict(())) * seen.weight
    assert seen.weight[5] == pytest.approx(30, rel=0.4)
    assert residual.std() == pytest.approx(0.3, rel=0.2)
    assert len(np.unique(seen.groups)) == ROWS


def test_pairs_that_look_alike_are_separated_by_pulls_and_payloads(plant, session):
    q, mass, pull, _ = session
    heavier = plant.dynamics(q, 0 * q, 0 * q, pull, mass + 0.4)[1]
    reading = (heavier @ np.diag(1 + GAIN)) + BIAS
    terms = [Term("payload", Site(), (0.0,)), Term("ft_gain", Site(), (0.0,) * 6),
             Term("ft_bias", Site(), (0.0,) * 6)]  # fmt: skip
    seen = observe(plant.model(), log_of(session, reading), METROLOGY)
    found, spread = truth.fit(plant.arm, seen, terms)
    values = np.concatenate([t.values for t in found])
    assert np.abs((values - np.concatenate([[0.4], GAIN, BIAS])) / spread).max() < 4


def test_equal_gains_and_one_payload_are_the_same(plant):
    q = truth.poses(N, 40, 5)
    log = truth.log_of(N, actual_q=q, ft_raw_wrench=np.eye(40, 6))
    seen = observe(plant.model(2.0), log, METROLOGY)
    heavier = seen.predict([Term("payload", Site(), (0.1,))])
    scaled = seen.predict([Term("ft_gain", Site(), (0.05,) * 6)])
    assert np.allclose(heavier, scaled, atol=1e-12)


def test_a_moving_payload_shows_its_inertia(plant):
    course = truth.course(N, 6)
    t = np.arange(4000) / 500
    q, qd, qdd = (course.at(t, order) for order in (0, 1, 2))
    _, wrench = plant.dynamics(q, qd, qdd, payload=2.5)
    rng = np.random.default_rng(0)
    reading = wrench + BIAS + rng.normal(0, 1, wrench.shape) * NOISE
    angles = np.round(q / 1.2e-5) * 1.2e-5
    log = truth.log_of(N, timestamp=t, actual_q=angles, ft_raw_wrench=reading)
    seen = observe(plant.model(2.0), log, METROLOGY)
    terms = [Term("payload", Site(), (0.0,)), Term("ft_bias", Site(), (0.0,) * 6)]
    found, spread = truth.fit(plant.arm, seen, terms)
    values = np.concatenate([term.values for term in found])
    assert np.abs((values - np.concatenate([[0.5], BIAS])) / spread).max() < 4
    assert ((seen.measured - seen.predict(found)) / NOISE).std() == pytest.approx(1, abs=0.03)
    assert seen.weight[3] == pytest.approx(30, rel=0.05)
    assert seen.order_in_time


def test_few_poses_with_many_loads_are_held_out_by_load(plant):
    q = np.repeat(truth.poses(N, 2, 0), 12, axis=0)
    mass = np.tile(np.arange(6.0), 4)
    log = truth.log_of(N, actual_q=q, payload=mass, ft_raw_wrench=np.eye(24, 6))
    seen = observe(plant.model(), log, METROLOGY)
    assert len(np.unique(seen.groups)) == 12


def test_readings_without_noise_get_a_usual_weight():
    assert torque_weight(np.zeros(6), np.ones((5, 6))) == 10.0
    assert torque_weight(np.repeat([0.5, 0.01], 3), np.ones((5, 6))) == pytest.approx(50)


def test_what_is_missing_is_named(plant):
    q = np.zeros((3, N))
    assert observe(plant.model(), truth.log_of(N, actual_q=q), METROLOGY) == NotObservable(
        "wrench", ("ft_raw_wrench",)
    )


def named_at(plant, q, step, wrench, **withhold):
    """Return the effects named, the wrench channel and the notes of readings at poses (rows, N)."""
    rng = np.random.default_rng(2)
    log = truth.log_of(
        N, timestamp=np.arange(len(q)) * step, actual_q=q + rng.normal(0, 1e-5, q.shape),
        ft_raw_wrench=wrench + rng.normal(0, 1, wrench.shape) * NOISE,
    )  # fmt: skip
    found = diagnose(plant.model(2.0), log, METROLOGY, **withhold)
    (channel,) = [c for c in found.channels if c.channel == "wrench"]
    return {cause.effect for cause in channel.causes}, channel, found.findings


@pytest.mark.parametrize(("rows", "step"), [(60, 20.0), (500, 0.01)], ids=["at rest", "recorded"])
def test_from_one_pose_neither_a_sensors_zero_nor_a_weight_is_named(plant, rows: int, step: float):
    q = np.tile(truth.poses(N, 1, 3), (rows, 1))
    weight = plant.dynamics(q, 0 * q, 0 * q, payload=2.0)[1]
    for wrench in (weight + BIAS, 1.2 * weight):
        named, channel, _ = named_at(plant, q, step, wrench)
        assert not named
        assert not channel.stand_ins
    named, channel, notes = named_at(plant, q, step, weight + BIAS, withhold=("ft_gain",))
    assert not named
    assert channel.depends_on == ()  # a constant depends on nothing
    facts = [note.fact for note in notes if isinstance(note, ChannelFinding)]
    (why,) = [fact.reason for fact in facts if isinstance(fact, NotAccused)]
    assert (why.failed, why.quantity) == (Check.SEPARATED, "payload or payload_cog")


def test_poses_that_turn_the_flange_separate_a_sensors_zero_from_a_weight(plant):
    q = truth.poses(N, 60, 3)
    weight = plant.dynamics(q, 0 * q, 0 * q, payload=2.0)[1]
    assert named_at(plant, q, 20.0, weight + BIAS)[0] == {"ft_bias"}
    assert named_at(plant, q, 20.0, 1.2 * weight)[0] == {"payload"}


def test_gains_that_imitate_a_load_do_not_replace_it(plant):
    """One load that nobody declared: equal gains are its mass, and leave neither of them sure.

    Gains that differ are a little better than none, beside a zero that jumps.
    """
    q = truth.poses(N, 80, 8)
    wrench = plant.dynamics(q, 0 * q, 0 * q, payload=1.2)[1] * (1 + GAIN) + 5 * BIAS
    wrench[32:, 2] += 0.8
    noise = np.random.default_rng(2).normal(0, 1, wrench.shape) * NOISE / 3
    log = truth.log_of(
        N, timestamp=np.arange(80) * 20.0, actual_q=q, ft_raw_wrench=wrench + noise
    )  # fmt: skip
    (channel,) = [c for c in diagnose(plant.model(), log, METROLOGY).channels
                  if c.channel == "wrench"]  # fmt: skip
    causes = {cause.effect: cause for cause in channel.causes}
    assert {"ft_bias", "payload"} <= set(causes)
    assert causes["payload"].parameters[0].value == pytest.approx(1.2, abs=0.05)


@pytest.mark.parametrize("rows", [60, 400], ids=["searched", "refitted on all rows"])
def test_at_rest_no_gain_is_named_for_a_zero_that_it_explains(plant, rows: int):
    """The encoders stand still to the last bit; across the weight a gain of 76 % fits a bias."""
    q = np.tile(truth.poses(N, 1, 3), (rows, 1))
    weight = plant.dynamics(q, 0 * q, 0 * q, payload=5.0)[1]
    bias = np.zeros(6)
    bias[:3] = 4.0 * np.cross(weight[0, :3], [0.0, 0.0, 1.0]) / np.linalg.norm(weight[0, :3])
    noise = np.random.default_rng(0).normal(0, 1, (rows, 6)) * np.repeat([0.25, 0.02], 3)
    log = truth.log_of(
        N, timestamp=np.arange(rows) * 0.01, actual_q=q, ft_raw_wrench=weight + bias + noise
    )
    (channel,) = diagnose(plant.model(5.0), log, METROLOGY).channels
    assert not channel.causes
    assert not channel.stand_ins
    assert channel.structured


def test_no_gap_is_larger_per_coordinate_than_at_most(plant):
    """Torques count in both: a gap of the torques alone was 8 N rms and 3 N at most."""
    rng = np.random.default_rng(0)
    q = truth.poses(N, 60, 4)
    weight = plant.dynamics(q, 0 * q, 0 * q, payload=2.0)[1]
    twisted = weight + np.array([0.0, 0.0, 0.0, 2.0, 0.0, 0.0]) + rng.normal(0, 1, (60, 6)) * NOISE
    log = truth.log_of(N, timestamp=np.arange(60) * 20.0, actual_q=q, ft_raw_wrench=twisted)
    (channel,) = diagnose(plant.model(2.0), log, METROLOGY).channels
    assert channel.gap_rms < channel.gap_max < np.sqrt(6) * channel.gap_rms * 3


@pytest.mark.parametrize("stands", [np.zeros(6), 4 * BIAS], ids=["zeros", "frozen"])
def test_readings_that_never_change_are_no_load(plant, session, stands):
    """No sensor, or one that stands still: its 0 N was a payload of -2 kg, with certainty."""
    model = plant.model(2.0)
    dead = log_of(session, np.zeros((ROWS, 6)))
    dead = replace(dead, columns={**dead.columns, "ft_raw_wrench": np.tile(stands, (ROWS, 1))})
    assert observe(model, dead, METROLOGY) == NotObservable(
        "wrench", ("ft_raw_wrench that changes",)
    )
    q, mass, pull, _ = session
    torque = plant.dynamics(q, 0 * q, 0 * q, pull, mass)[0]
    noise = np.random.default_rng(3).normal(0, 0.1, torque.shape)
    held = {**dead.columns, "actual_current_as_torque": torque + noise}
    found = diagnose(model, replace(dead, columns=held), METROLOGY)
    assert [channel.channel for channel in found.channels] == ["torque"]
    assert not found.channels[0].causes
    alive = replace(log_of(session, session[3]), path="alive.csv")
    seen = observe(model, join_sessions([alive, dead], model), METROLOGY)
    assert isinstance(seen, Observation)
    assert seen.rows.max() < ROWS  # of two sessions, that whose sensor measures


@pytest.mark.parametrize(("axes", "stands"), [((0,), 0.0), ((2,), -4.2), ((3, 4, 5), 0.0)])
def test_an_axis_that_never_changes_under_a_load_that_does_is_dead(plant, session, axes, stands):
    """A dead axis was a bias of -10 N, with certainty; a sensor of forces alone was unexplained."""
    dead = log_of(session, session[3])
    dead.columns["ft_raw_wrench"][:, list(axes)] = stands
    assert observe(plant.model(2.0), dead, METROLOGY) == NotObservable(
        "wrench", tuple(f"ft_raw_wrench_{axis} that changes" for axis in axes)
    )


def test_a_sensor_of_zeros_at_rest_in_each_session_is_dead(plant, session):
    rows = np.repeat(np.arange(6), 5)
    log = truth.log_of(
        N, timestamp=np.arange(30.0) * 5, session=rows, actual_q=session[0][rows],
        ft_raw_wrench=np.zeros((30, 6)),
    )  # fmt: skip
    seen = observe(plant.model(2.0), with_sessions(log, plant.model(2.0)), METROLOGY)
    assert seen == NotObservable("wrench", ("ft_raw_wrench that changes",))
