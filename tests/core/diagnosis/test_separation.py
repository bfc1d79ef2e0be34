"""What to measure next: inside the limits, and where the open explanations differ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.blind.mechanics import Session, stand, turn
from benchmarks.blind.session import Plan
from gapbridge.core.arm import JointLimits
from gapbridge.core.diagnosis import separation
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.separation import next_measurements
from gapbridge.core.effects import CATALOGUE, Site
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.sessions import join_sessions

PLAY = 9e-4  # rad
OFFSET = small.turned(2, lambda s, q: np.full(len(q), -PLAY / 2))  # all come from below
ONE_SIDED = Plan(poses=60, both_sides=False)


def session_at(q, payload: float, approach) -> Session:
    q = np.atleast_2d(np.array(q))
    return Session(
        time=np.zeros(1), q=q, payload_mass=np.array([payload]), payload_cog=np.zeros((1, 3)),
        tcp_wrench=np.zeros((1, 6)), temperature=np.full((1, 3), 25.0),
        approach=np.atleast_2d(np.array(approach, dtype=float)),
        from_where=q - 0.05 * np.array(approach),
    )  # fmt: skip


@pytest.fixture(scope="module")
def tied():
    """A joint that always comes from one side: its play looks like an offset."""
    session = small.session_of(3, ONE_SIDED)
    position = small.readings(OFFSET, session, 3)
    log = small.log_of(session, position)
    return diagnose(small.model_of(), log, Metrology(registered=True, sigma=small.SIGMA))


def test_a_tie_is_reported_with_a_measurement_that_resolves_it(tied):
    (cause,) = tied.channels[0].causes
    names = {cause.effect, *cause.indistinguishable_from}
    assert {"joint_offset", "backlash"} <= names
    requested = [
        m for m in tied.next_measurements if set(m.separates) == {"joint_offset", "backlash"}
    ]
    assert requested


def test_proposed_poses_are_within_the_joint_limits_and_the_rated_load(tied):
    for reported in tied.next_measurements:
        assert np.all(np.array(reported.q) >= small.LIMITS.lower)
        assert np.all(np.array(reported.q) <= small.LIMITS.upper)
        assert 0 <= reported.payload <= small.KIND.rated * 1.05


def test_at_a_proposed_pose_the_tied_pair_really_differs(tied):
    """The two real arms differ there by the expected gain."""
    play = small.turned(2, lambda s, q: s.approach[:, 1] * -PLAY / 2)
    session = small.session_of(3, ONE_SIDED)
    assert np.allclose(
        stand(OFFSET, session).tcp, stand(play, session).tcp, atol=1e-9
    )  # on the log
    for reported in tied.next_measurements:
        if set(reported.separates) != {"joint_offset", "backlash"}:
            continue
        assert reported.approach is not None
        there = session_at(reported.q, reported.payload, reported.approach)
        apart = np.linalg.norm(stand(OFFSET, there).tcp - stand(play, there).tcp)
        assert apart / small.FLOOR == pytest.approx(reported.expected_gain, rel=0.25)
        assert apart > 5 * small.FLOOR


def test_proposals_of_one_question_differ(tied):
    for names in {m.separates for m in tied.next_measurements}:
        poses = [np.array(m.q) for m in tied.next_measurements if m.separates == names]
        assert all(np.abs(a - b).max() > 0.1 for a in poses for b in poses if a is not b)


def test_a_difference_that_a_frame_absorbs_is_never_proposed():
    """Joint 1 and the frame of an unregistered instrument are the same at every pose."""
    found = small.diagnosed("none", 0, False)
    requested = {e for m in found.next_measurements for e in m.separates}
    assert "joint_offset" not in requested


@pytest.mark.parametrize("registered", [True, False])
def test_a_frame_is_fitted_only_where_it_is_free(monkeypatch, registered):
    """A target that is remounted in two registered sessions has as many free numbers as a frame."""
    logs = []
    for seed in (0, 1):
        session = small.session_of(seed)
        log = small.log_of(session, small.readings(small.NOMINAL, session, seed))
        logs.append(small.replace(log, path=f"{seed}.csv"))
    model, fitted = small.model_of(), []
    monkeypatch.setattr(
        separation, "_frame_correction", lambda _, __, p: fitted.append(1) or np.zeros_like(p)
    )
    metrology = Metrology(registered=registered, sigma=small.SIGMA, remounted=True)
    found = diagnose(model, join_sessions(logs, model), metrology)
    assert found.channels[0].selection.observation.nuisance.shape[2] >= 6
    assert bool(fitted) is not registered


def test_the_same_question_gets_the_same_answer(tied):
    model, log = small.model_of(), small.log_of(small.session_of(3, ONE_SIDED), np.zeros((60, 3)))
    again = [next_measurements(model, log, tied.channels, seed=4) for _ in range(2)]
    assert again[0] == again[1]
    assert again[0] != next_measurements(model, log, tied.channels, seed=5)


def test_a_pose_that_answers_the_same_question_of_two_joints_is_listed_once(tied, monkeypatch):
    model, log = small.model_of(), small.log_of(small.session_of(3, ONE_SIDED), np.zeros((60, 3)))
    once, questions = next_measurements(model, log, tied.channels), separation._open_questions
    monkeypatch.setattr(separation, "_open_questions", lambda *given: [*questions(*given)] * 2)
    assert once
    assert next_measurements(model, log, tied.channels) == once


@settings(max_examples=15, deadline=None)
@given(
    low=st.floats(-9, 3), width=st.floats(0.05, 9), open_below=st.booleans(), seed=st.integers(0, 9)
)
def test_any_limits_are_kept(tied, low, width, open_below, seed):
    limits = JointLimits(
        np.array([-np.inf if open_below else low, -2.0, -np.inf]),
        np.array([low + width, 2.0, np.inf]),
        np.full(3, np.inf), np.full(3, np.inf),
    )  # fmt: skip
    model = small.model_of()
    model = replace(model, arm=replace(model.arm, limits=limits))
    log = small.log_of(small.session_of(3, ONE_SIDED), np.zeros((60, 3)))
    for reported in next_measurements(model, log, tied.channels, seed):
        q = np.array(reported.q)
        assert np.all((limits.lower <= q) & (q <= limits.upper))
        assert np.ptp(q) < 20


COG = np.array([0.03, -0.02, 0.08])
GAIN = np.array([0.05, -0.04, 0.03, 0.06, -0.05, 0.04])
NOISE = np.repeat([0.2, 0.01], 3)  # N, Nm


def flange_reading(q, payload):
    """Return what a payload at rest does to the flange (N, 6), flange axes."""
    hand = stand(small.NOMINAL, small_session(q)).flange_rotation
    weight = np.einsum("nji,j->ni", hand, small.NOMINAL.gravity) * np.reshape(payload, (-1, 1))
    return np.hstack([weight, np.cross(COG, weight)])


def small_session(q) -> Session:
    return session_at(np.atleast_2d(q), 0.0, np.zeros_like(np.atleast_2d(q)))


@pytest.fixture(scope="module")
def one_attitude():
    """Only joint 1 turns, about the vertical: the sensor carries the same in every pose."""
    rng = np.random.default_rng(0)
    q = np.column_stack([rng.uniform(-2, 2, 60), np.full(60, 0.7), np.full(60, -1.1)])
    wrench = flange_reading(q, 4.0) * (1 + GAIN) + rng.normal(0, 1, (60, 6)) * NOISE
    columns = {
        "timestamp": np.arange(60) * 20.0, "actual_q": q, "payload": np.full(60, 4.0),
        "payload_cog": np.tile(COG, (60, 1)), "ft_raw_wrench": wrench,
    }  # fmt: skip
    return diagnose(small.model_of(), Log("small.csv", columns, 3))


def test_a_tie_of_the_flange_sensor_has_a_proposed_measurement(one_attitude):
    (channel,) = one_attitude.channels
    assert not channel.causes  # neither is named
    pair = {"ft_bias", "ft_gain"}
    requested = [m for m in one_attitude.next_measurements if set(m.separates) == pair]
    assert requested
    bias = (flange_reading([0.0, 0.7, -1.1], 4.0) * GAIN)[0]
    for reported in requested:
        q = np.array(reported.q)
        assert np.all((small.LIMITS.lower <= q) & (q <= small.LIMITS.upper))
        apart = flange_reading(q, reported.payload)[0] * GAIN - bias
        promised = np.linalg.norm(apart * (0.2 / NOISE)) / 0.2
        assert promised == pytest.approx(reported.expected_gain, rel=0.35)
        assert promised > 3


def test_no_pose_is_proposed_for_what_no_pose_decides(one_attitude):
    """A drift needs time, whatever the pose."""
    assert not any(m.separates == ("ft_drift",) for m in one_attitude.next_measurements)
    assert all(m.expected_gain >= 1 for m in one_attitude.next_measurements)


def test_an_effect_that_is_not_excited_has_a_measurement_that_excites_it():
    """Few nearly equal poses show nothing of the gravity's direction; others would."""
    near = small.session_of(4, Plan(poses=60, span=0.03, blocks=1, pulled=0.0))
    model = small.model_of(small.COMPLIANT)
    read = small.readings(small.COMPLIANT, near, 4, registered=False)
    found = diagnose(model, small.log_of(near, read), Metrology(sigma=small.SIGMA))
    silent = {c.effect for c in found.channels[0].considered if not c.excited}
    assert "gravity_direction" in silent
    requested = [m for m in found.next_measurements if m.separates == ("gravity_direction",)]
    assert requested
    assert {e for m in found.next_measurements for e in m.separates} <= silent
    spread = np.abs(np.array([m.q for m in requested]) - near.q.mean(axis=0)).max(axis=1)
    assert np.all(spread > 0.5)
    # what the frame, fitted anew on the log, leaves of a gravity of usual size that leans
    (size, _) = CATALOGUE["gravity_direction"].parameters(model.arm, Site())
    leaning = small.replace(
        small.COMPLIANT,
        gravity=turn(np.array([[size.scale, size.scale, 0.0]]))[0] @ small.NOMINAL.gravity,
    )
    for reported in requested:
        there = session_at(reported.q, reported.payload, np.ones(3))
        there = small.replace(there, payload_cog=near.payload_cog[-1:])
        promised = beside_a_frame(leaning, small.COMPLIANT, near, there)
        assert promised == pytest.approx(
            reported.expected_gain * found.channels[0].noise_floor_rms, rel=0.1
        )


def beside_a_frame(one, other, log: Session, there: Session) -> float:
    """Return how far (m) two arms differ at a pose once a frame has carried one onto the other."""
    a, b = stand(one, log).tcp, stand(other, log).tcp
    turned, _ = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
    moved = turned.apply(stand(one, there).tcp - a.mean(axis=0)) + b.mean(axis=0)
    return float(np.linalg.norm(moved - stand(other, there).tcp))
