"""Motion from logs: derivatives, rests, jumps, and timestamps as recorders leave them."""

from __future__ import annotations

from dataclasses import replace

import moving_truth as truth
import numpy as np
import pytest

from gapbridge.core.derivatives import differentiate, signal_noise
from gapbridge.core.errors import LogError
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.motion import motion_of, time_finding, without_turns, without_wrong_speeds

COURSE = truth.course(6, 1)
ENCODER = 1.2e-5  # rad


def recording(rate=500.0, seconds=10.0, **more):
    t = np.arange(int(rate * seconds)) / rate
    q = np.round(COURSE.at(t) / ENCODER) * ENCODER
    return t, truth.log_of(6, timestamp=t, actual_q=q, **more)


@pytest.mark.parametrize("rate", [500.0, 125.0, 25.0])
def test_derivatives_of_encoder_angles_are_those_of_the_course(rate):
    t, log = recording(rate, 20)
    motion = motion_of(log)
    good = motion.valid
    assert good.mean() > 0.9
    assert np.abs(motion.qd - COURSE.at(t, 1))[good].max() < 0.01
    error = (motion.qdd - COURSE.at(t, 2))[good]
    assert np.sqrt(np.mean(error**2)) < 0.02 * COURSE.at(t, 2).std()


def test_measured_speeds_without_noise_make_accelerations_exact():
    rate = 500.0
    t = np.arange(5000) / rate
    log = truth.log_of(6, timestamp=t, actual_q=COURSE.at(t), actual_qd=COURSE.at(t, 1))
    motion = motion_of(log)
    assert np.abs(motion.qdd - COURSE.at(t, 2))[motion.valid].max() < 1e-4


WRONG_SPEEDS = {
    "degrees": (np.full(6, 180 / np.pi), (1, 2, 3, 4, 5, 6)),
    "zeros": (np.zeros(6), (1, 2, 3, 4, 5, 6)),
    "one joint without": (np.array([1, 1, 0, 1, 1, 1]), (3,)),
    "another sign": (np.array([1, -1, 1, 1, 1, 1]), (2,)),
    "motors": (np.full(6, 101.0), (1, 2, 3, 4, 5, 6)),
}


@pytest.mark.parametrize("wrong", WRONG_SPEEDS)
def test_speeds_that_are_not_those_of_the_angles_are_left_out(wrong):
    """In degrees a payload and first moments were named; zeros made a recording poses at rest."""
    factor, joints = WRONG_SPEEDS[wrong]
    t, log = recording(125.0, 20)
    log.columns["actual_qd"] = COURSE.at(t, 1) * factor
    motion = motion_of(log)
    assert motion.moving
    assert np.abs(motion.qd - COURSE.at(t, 1))[motion.valid].max() < 0.01
    left = without_wrong_speeds(log)
    assert not left.has("actual_qd")
    assert left.wrong_speeds[0] == joints
    assert left.wrong_speeds[1] == pytest.approx(factor[joints[0] - 1], abs=0.01 * factor.max())


@pytest.mark.parametrize("rate", [500.0, 25.0, 8.0])
@pytest.mark.parametrize("rounded", [False, True])
def test_speeds_with_noise_delay_and_rests_are_kept(rate, rounded):
    t, log = recording(rate, 40)
    seen = np.minimum(t, 25.0)  # the arm rests at the end
    noise = np.random.default_rng(0).normal(0, 0.05, (len(t), 6))
    speed = np.where((t < 25)[:, None], COURSE.at(t - 0.02, 1), 0.0) + noise
    log.columns.update(actual_q=COURSE.at(seen), actual_qd=speed)
    if rounded:
        log.columns["timestamp"] = np.floor(t * 10) / 10
    assert without_wrong_speeds(log) is log


def test_poses_at_rest_that_were_given_times_stay_poses_at_rest():
    q = truth.poses(6, 200, 3) / 10
    log = truth.log_of(6, timestamp=np.arange(200) * 0.1, actual_q=q, actual_qd=np.zeros((200, 6)))
    assert without_wrong_speeds(log) is log
    assert not motion_of(log).moving


def test_the_noise_of_a_smooth_signal_is_found():
    t = np.arange(5000) / 500
    noisy = COURSE.at(t) + np.random.default_rng(0).normal(0, 1e-4, (5000, 6))
    assert np.allclose(signal_noise(noisy), 1e-4, rtol=0.1)


def test_the_window_follows_the_noise_and_its_error_is_reported():
    t = np.arange(5000) / 500
    quiet = differentiate(COURSE.at(t), 1 / 500, 2)
    loud = differentiate(
        COURSE.at(t) + np.random.default_rng(0).normal(0, 1e-4, (5000, 6)), 1 / 500, 2
    )
    assert loud.half_width > quiet.half_width
    error = (loud.value - COURSE.at(t, 2))[100:-100]
    assert np.all(error.std(axis=0) < 2 * loud.noise)


def test_corners_of_a_trapezoidal_speed_are_left_out():
    t = np.arange(6000) / 500
    acceleration = np.select([(t % 3) < 0.3, (t % 3) < 1.2, (t % 3) < 1.5], [4.0, 0.0, -4.0], 0.0)
    speed = np.concatenate([[0], np.cumsum(acceleration[:-1])]) / 500
    angle = np.concatenate([[0], np.cumsum(speed[:-1] + acceleration[:-1] / 1000)]) / 500
    q = np.round(np.tile(angle[:, None], 6) / ENCODER) * ENCODER
    motion = motion_of(truth.log_of(6, timestamp=t, actual_q=q))
    assert 0.4 < motion.valid.mean() < 0.99
    error = np.abs(motion.qdd - acceleration[:, None])
    assert error[~motion.valid].max() > 1.0
    assert error[motion.valid].max() < 0.5


def test_poses_at_rest_have_no_derivatives():
    q = truth.poses(6, 30, 0)
    for columns in ({}, {"timestamp": np.arange(30) * 30.0}, {"timestamp": np.arange(30) * 2e-3}):
        motion = motion_of(truth.log_of(6, actual_q=q, **columns))
        assert not motion.moving
        assert not motion.qd.any()
        assert not motion.qdd.any()


def test_accelerations_bridge_a_gap_shorter_than_their_window():
    """A gap of 18 ms, as a Panda's; where a delayed command was in it is not known."""
    t = np.delete(np.arange(5000) / 500.0, slice(2000, 2008))
    q = np.round(COURSE.at(t) / ENCODER) * ENCODER
    motion = motion_of(truth.log_of(6, timestamp=t, actual_q=q))
    near = slice(1950, 2050)
    assert motion.valid[near].all()
    error = (motion.qdd - COURSE.at(t, 2))[near]
    assert np.sqrt(np.mean(error**2)) < 0.03 * COURSE.at(t, 2).std()
    assert motion.stretch[1999] == 0
    assert motion.stretch[2000] == 1


def test_a_gap_in_time_ends_a_stretch():
    t, log = recording()
    kept = np.flatnonzero((t < 4) | (t > 6))
    motion = motion_of(log.select(kept))
    assert motion.stretch[-1] == 1
    assert not motion.valid[[0, 1999, 2000, -1]].any()
    assert np.abs(motion.qd - COURSE.at(t[kept], 1))[motion.valid].max() < 0.01


@pytest.mark.parametrize("rest", [slice(0, 3000), slice(5000, 8000)], ids=["before", "after"])
def test_a_rest_costs_no_row_of_the_motion(rest):
    """Encoders at rest do not flicker as in motion; what is moving chooses the windows."""
    t = np.arange(8000) / 500
    q = COURSE.at(np.arange(5000) / 500) + np.random.default_rng(0).normal(0, 3e-5, (5000, 6))
    alone = motion_of(truth.log_of(6, timestamp=t[:5000], actual_q=q))
    still = np.tile(q[0 if rest.start == 0 else -1], (3000, 1))
    moved = slice(3000, 8000) if rest.start == 0 else slice(0, 5000)
    whole = np.concatenate([still, q] if rest.start == 0 else [q, still])
    motion = motion_of(truth.log_of(6, timestamp=t, actual_q=whole))
    assert motion.valid[moved].sum() > 0.95 * alone.valid.sum()
    assert motion.valid[rest].mean() > 0.9
    assert np.abs(motion.qdd[rest][100:-100]).max() < 1e-9
    good = motion.valid[moved] & alone.valid
    error = (motion.qdd[moved] - alone.qdd)[good]
    assert np.sqrt(np.mean(error**2)) < 0.05 * alone.qdd[good].std()


def test_accelerations_come_from_speeds_where_those_of_the_angles_jump():
    """The angles' noise is not white: what two windows make of it differs."""
    t = np.arange(5000) / 500
    bursts = np.random.default_rng(0).normal(0, 3e-5, (5000, 6))
    bursts[(t % 2.0) > 0.3] *= 0.05
    speeds = COURSE.at(t, 1) + np.random.default_rng(1).normal(0, 3e-4, (5000, 6))
    log = truth.log_of(6, timestamp=t, actual_q=COURSE.at(t) + bursts, actual_qd=speeds)
    alone = motion_of(truth.log_of(6, timestamp=t, actual_q=COURSE.at(t) + bursts))
    both = motion_of(log)
    assert both.valid.mean() > alone.valid.mean() + 0.1
    error = (both.qdd - COURSE.at(t, 2))[both.valid]
    assert error.std() < 0.05


def test_time_that_runs_back_is_reported_with_its_line_also_in_a_selection():
    t, log = recording()
    back = replace(log, columns=dict(log.columns) | {"timestamp": np.where(t == t[900], 0.0, t)})
    for part, line in ((back, 902), (back.select(slice(500, None)), 902)):
        with pytest.raises(LogError, match=f"row {line}, column timestamp: found 0 after"):
            motion_of(part)


def test_uneven_timestamps_are_honoured():
    t = np.sort(np.arange(5000) / 500 + np.random.default_rng(0).uniform(-4e-4, 4e-4, 5000))
    motion = motion_of(truth.log_of(6, timestamp=t, actual_q=COURSE.at(t)))
    assert np.abs(motion.qd - COURSE.at(t, 1))[motion.valid].max() < 1e-3


def test_cycles_recorded_twice_count_once_and_are_reported():
    _, log = recording()
    twice = log.select(np.repeat(np.arange(len(log)), 2))
    motion = motion_of(twice)
    assert len(motion) == len(log)
    assert np.array_equal(motion.rows, np.arange(0, 2 * len(log), 2))
    assert time_finding(twice) == LogFinding(LogCheck.COPIED_ROWS, (len(log), 2 * len(log), 2))
    assert time_finding(log) is None


def test_cycles_recorded_twice_are_recognised_where_cells_are_empty():
    _, log = recording()
    measured = np.full((len(log), 3), np.nan)
    measured[::10] = 0.1
    twice = replace(log, columns=dict(log.columns) | {"measured_position": measured}).select(
        np.repeat(np.arange(len(log)), 2)
    )
    assert len(motion_of(twice)) == len(log)
    assert time_finding(twice) == LogFinding(LogCheck.COPIED_ROWS, (len(log), 2 * len(log), 2))


def test_rounded_timestamps_are_replaced_by_an_even_clock():
    t, log = recording(25.0, 40)
    rounded = truth.log_of(6, timestamp=np.round(t, 1), actual_q=log.columns["actual_q"])
    motion = motion_of(rounded)
    assert np.abs(motion.t - motion.t.mean() - (t - t.mean())).max() < 0.01
    finding = time_finding(rounded)
    assert finding is not None
    assert finding.check is LogCheck.ROUNDED_TIME
    assert finding.values[0] == pytest.approx(0.1)


def test_other_repeats_name_their_row():
    t, log = recording()
    stuck = t.copy()
    stuck[1000:3000] = stuck[1000]
    with pytest.raises(LogError, match=r"row 1003, column timestamp: found 2 again"):
        motion_of(truth.log_of(6, timestamp=stuck, actual_q=log.columns["actual_q"]))


def test_time_that_runs_backwards_names_its_row():
    t, log = recording()
    t = t.copy()
    t[700:] -= 1
    with pytest.raises(LogError, match=r"row 702, column timestamp: .* expected rows in time"):
        motion_of(truth.log_of(6, timestamp=t, actual_q=log.columns["actual_q"]))


def test_direction_is_smooth_only_where_it_is_unsure():
    _, log = recording()
    motion = motion_of(log)
    fast = np.abs(motion.qd) > motion.still
    assert np.all(np.abs(motion.direction[fast] - np.sign(motion.qd[fast])) < 1e-3)
    assert not motion.turning[fast].any()


def test_held_samples_do_not_keep_the_windows_short():
    """A recorder that polls an arm holds some speeds for two or three rows: no white noise."""
    rng, t = np.random.default_rng(4), np.arange(8000) / 500
    noisy = COURSE.at(t, 1) + rng.normal(0, 4e-3, (8000, 6))
    taken = np.maximum.accumulate(np.where(rng.random(8000) < 0.5, np.arange(8000), 0))
    log = truth.log_of(6, timestamp=t, actual_q=COURSE.at(t)[taken], actual_qd=noisy[taken])
    motion = motion_of(log)
    error = (motion.qdd - COURSE.at(t, 2))[motion.valid]
    assert motion.valid.mean() > 0.8
    assert np.sqrt(np.mean(error**2)) < 0.1


def wrapped(q):
    return (q + np.pi) % (2 * np.pi) - np.pi


@pytest.mark.parametrize("middle", [np.pi, -np.pi, 0.5 * np.pi - 6.0])
def test_angles_that_wrap_run_on_within_limits_of_two_turns(middle):
    t = np.arange(5000) / 500
    q = COURSE.at(t)
    q[:, 5] += middle - q[:, 5].mean()
    jumps = truth.log_of(6, timestamp=t, target_q=q, actual_q=wrapped(q))
    log, motion = without_turns(jumps), motion_of(jumps)
    assert 6 in log.turned
    for values in (log.columns["actual_q"], motion.q):
        np.testing.assert_allclose(np.diff(values, axis=0), np.diff(q, axis=0), atol=1e-12)
        assert np.abs(values).max() <= 2 * np.pi
    np.testing.assert_allclose(motion.target_q, motion.q, atol=1e-9)
    assert np.abs(motion.qd[motion.valid]).max() < 1.1 * np.abs(COURSE.at(t, 1)).max()
    assert without_turns(log) is log


def test_a_joint_that_was_away_in_a_pause_has_not_wrapped():
    t, log = recording(125, 10)
    q = log.columns["actual_q"] + np.where(t > 5, 4.0, 0.0)[:, None]
    paused = t + np.where(t > 5, 3.0, 0.0)
    log = truth.log_of(6, timestamp=paused, actual_q=q)
    assert without_turns(log) is log


def test_poses_at_rest_stay_and_their_commands_are_on_the_turn_of_the_encoders():
    q = truth.poses(6, 30, 0) * 1.5
    at_rest = truth.log_of(6, timestamp=np.arange(30) * 5.0, target_q=wrapped(q), actual_q=q + 1e-4)
    log = without_turns(at_rest)
    np.testing.assert_array_equal(log.columns["actual_q"], q + 1e-4)
    np.testing.assert_allclose(log.columns["target_q"], q, atol=1e-12)


def test_degrees_do_not_wrap():
    t, log = recording(25, 10)
    degrees = truth.log_of(6, timestamp=t, actual_q=np.degrees(log.columns["actual_q"]) * 3)
    assert without_turns(degrees) is degrees
