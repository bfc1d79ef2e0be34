"""Positions recorded in motion: neighbours in time share their errors, as those of a pose do."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
import small_arm as small

from gapbridge.core.diagnosis.causes import Considered, Outcome
from gapbridge.core.diagnosis.channels.position import observe
from gapbridge.core.diagnosis.diagnosis import Diagnosis, diagnose
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.regions import regions
from gapbridge.core.diagnosis.separation import next_measurements
from gapbridge.core.diagnosis.thinning import thinned_poses
from gapbridge.core.effects import CATALOGUE, Site, Term
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.sessions import join_sessions

REGISTERED = Metrology(registered=True, sigma=1e-5)
TRUE = Term("joint_offset", Site(2), (1e-3,))
WHITE, SMOOTH = 1e-5, 3e-5  # m
ROWS = 240


def recording(step: float = 0.01, rows: int = ROWS, seed: int = 1) -> Log:
    """Return a smooth motion, its positions with an error that is smooth in time (0.1 s)."""
    rng, t = np.random.default_rng(seed), np.arange(rows) * 0.01
    rate, phase = rng.uniform(0.4, 1.5, (3, 3)), rng.uniform(0, 6, (3, 3))
    q = np.array([0.2, 0.6, -1.1]) + 0.35 * np.sin(rate * t[:, None, None] + phase).sum(axis=1)
    window = np.exp(-0.5 * (np.arange(-20, 21) / 5) ** 2)
    white = rng.normal(0, SMOOTH / np.linalg.norm(window), (rows + 40, 3))
    error = np.stack([np.convolve(column, window, "valid") for column in white.T], axis=1)
    position = small.model_of().with_terms([TRUE]).predict(q, Loads()).position + error
    position += rng.normal(0, WHITE, position.shape)
    t = np.arange(rows) * step
    return Log("m.csv", {"timestamp": t, "actual_q": q, "measured_position": position}, 3)


def observed(log: Log, metrology: Metrology = REGISTERED) -> Observation:
    found = observe(small.model_of(), log, metrology)
    assert isinstance(found, Observation)
    return found


@functools.cache
def diagnosed() -> Diagnosis:
    others = [name for name in CATALOGUE if name != "joint_offset"]
    return diagnose(small.model_of(), recording(), REGISTERED, withhold=others)


def test_rows_of_one_motion_are_stretches_of_time_and_not_poses() -> None:
    moving, at_rest = observed(recording()), observed(recording(step=30.0))
    assert moving.order_in_time
    np.testing.assert_array_equal(moving.groups, np.arange(ROWS) // 10)
    assert not at_rest.order_in_time
    assert len(set(at_rest.groups)) > 200
    assert at_rest.instrument is None


def test_the_noise_of_a_motion_is_that_of_neighbouring_samples() -> None:
    instrument = observed(recording()).instrument
    assert instrument is not None
    np.testing.assert_allclose(instrument(), WHITE, rtol=0.25)
    (channel,) = diagnosed().channels
    assert channel.noise_floor_source == "neighbouring samples"
    assert channel.noise_floor_rms == pytest.approx(WHITE, rel=0.25)


def test_intervals_are_over_stretches_of_time() -> None:
    (channel,) = diagnosed().channels
    (cause,) = channel.causes
    assert (cause.effect, cause.joints) == ("joint_offset", (2,))
    selection, chosen = channel.selection, channel.selection.term_index
    observation = replace(channel.selection.observation, groups=np.arange(ROWS))
    single = HeldOut(replace(selection, observation=observation)).shrink(chosen, ())
    width, of_rows = (np.ptp(shrink.interval) for shrink in (cause.shrink, single))
    assert width > 2 * of_rows
    assert channel.judgement.unnamed_part is not None  # the std is over them too


def test_scatter_is_over_few_long_stretches_and_pauses_are_left_out() -> None:
    log = recording()
    t = log.columns["timestamp"] + np.where(np.arange(ROWS) < ROWS // 2, 0.0, 3600.0)
    paused = observed(replace(log, columns=log.columns | {"timestamp": t}))
    for observation in (observed(log), paused):
        region = regions(observation, np.ones(ROWS, dtype=bool))
        np.testing.assert_allclose(np.bincount(region), ROWS // 8, atol=1)


def test_the_next_positions_are_measured_at_rest() -> None:
    (channel,) = diagnosed().channels
    backlash = Considered("backlash", None, 0.0, Outcome.NOT_EXCITED)
    proposed = next_measurements(
        small.model_of(), recording(), [replace(channel, considered=(backlash,))]
    )
    assert proposed
    assert all(m.velocity is None and m.approach is not None for m in proposed)


def test_stretches_stay_with_their_rows_where_frames_move_and_rows_are_left_out() -> None:
    log, free = recording(), Metrology(sigma=1e-5)
    whole = observed(log, free)
    moved = whole.rebased(np.zeros(whole.nuisance.shape[2]), ())
    assert moved.order_in_time
    np.testing.assert_array_equal(moved.groups, whole.groups)
    few = thinned_poses(whole, log, lambda part: observed(part, free), 20)
    assert few.order_in_time
    np.testing.assert_array_equal(few.groups, whole.groups[few.rows])
    assert few.instrument is whole.instrument


def test_poses_measured_at_stops_of_a_recording_are_poses() -> None:
    log = recording()
    position = np.full((ROWS, 3), np.nan)
    position[::22] = log.columns["measured_position"][::22]
    stops = observed(replace(log, columns=log.columns | {"measured_position": position}))
    assert not stops.order_in_time
    assert stops.instrument is None


def test_two_recordings_are_stretches_of_both() -> None:
    second = replace(recording(seed=2), path="n.csv")
    both = observed(join_sessions([recording(), second], small.model_of()))
    assert both.order_in_time
    np.testing.assert_allclose(np.bincount(both.groups), 20, atol=1)
