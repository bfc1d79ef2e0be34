"""The noise floor is measured: repeats, neighbouring samples; and residuals that are not white."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small
from further import further
from scipy.signal import butter, filtfilt, lfilter

import gapbridge.core.diagnosis.diagnosis as whole
from gapbridge.core.derivatives import signal_noise
from gapbridge.core.diagnosis import thinning
from gapbridge.core.diagnosis.channels.recording import instrument_noise, signal_step
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.finding import Check
from gapbridge.core.diagnosis.noise_floor import _portmanteau, noise_floor, repeat_variance
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.motion import motion_of


@pytest.mark.parametrize("effect", ["none", *further("cross_coupling")])
def test_without_a_cause_the_held_out_gap_is_the_gap(effect: str) -> None:
    """Nothing is fitted but the frame, before as well as after, over the same samples."""
    for registered in (True, False):
        (channel,) = small.diagnosed(effect, 0, registered).channels
        assert not channel.causes
        assert channel.remaining_rms_held_out == channel.gap_rms


def repeated(effect: str, times: int = 3):
    """Return a log that comes to each pose several times, and a model without the effect."""
    drawn = small.session_of(3, small.Plan(poses=30))
    session = replace(drawn, **{k: np.repeat(v, times, axis=0) for k, v in vars(drawn).items()})
    session = replace(session, time=np.arange(len(session.time)) * 20.0)
    return small.log_of(session, small.readings(small.REAL[effect], session, 3))


@pytest.mark.slow
def test_repeats_measure_the_floor_under_an_unknown_thirty_times_as_large() -> None:
    metrology = Metrology(registered=True, sigma=small.SIGMA)
    (channel,) = diagnose(small.model_of(), repeated("cross_coupling"), metrology).channels
    assert channel.noise_floor_source == "repeats"
    assert channel.noise_floor_rms == pytest.approx(small.FLOOR, rel=0.15)
    assert channel.gap_rms > 4 * small.FLOOR


def test_without_repeats_a_structured_residual_is_no_measure_of_noise() -> None:
    (channel,) = small.diagnosed("cross_coupling").channels
    assert channel.structured
    assert (channel.noise_floor_rms, channel.noise_floor_source) == (small.SIGMA, "stated")


def test_a_pose_under_another_load_is_no_repeat() -> None:
    observation = small.diagnosed("none").channels[0].selection.observation
    count = len(observation.rows)
    kept, residual = np.ones(count, dtype=bool), np.ones((count, 3))
    quantities = {"payload": np.arange(count) * 0.1}
    twice = replace(observation, groups=np.arange(count) // 2, quantities=quantities)
    assert repeat_variance(twice, residual, kept)[1] == 0
    same = replace(twice, quantities={"payload": np.zeros(count)})
    assert repeat_variance(same, residual, kept) == (0.0, 3 * (count // 2))


def recording(noise: float, step: float = 0.0) -> tuple[np.ndarray, Log]:
    t = np.arange(4000) * 0.004
    q = np.sin(t)[:, None] * np.linspace(0.5, 1, 3)
    signal = 20 * np.cos(t)[:, None] + np.random.default_rng(0).normal(0, noise, (4000, 3))
    if step:
        signal = np.round(signal / step) * step
    return signal, Log("r.csv", {"timestamp": t, "actual_q": q}, 3)


def test_neighbouring_samples_measure_a_recordings_noise() -> None:
    signal, log = recording(0.3)
    assert instrument_noise(signal, motion_of(log)) == pytest.approx([0.3] * 3, rel=0.1)


@pytest.mark.parametrize("joints", [slice(None), slice(1)])  # the rms needs every one of them
def test_a_recording_behind_a_low_pass_is_no_measure_of_its_noise(joints: slice) -> None:
    signal, log = recording(0.3)
    smoothed = signal.copy()
    smoothed[:, joints] = filtfilt(*butter(4, 20, fs=250), signal[:, joints], axis=0)
    assert signal_noise(smoothed)[0] < 1e-3
    assert instrument_noise(smoothed, motion_of(log)) is None


def test_a_sensors_own_filter_leaves_its_noise() -> None:
    signal, log = recording(0.3)
    filtered = lfilter(*butter(1, 20, fs=250), signal, axis=0)
    assert instrument_noise(filtered, motion_of(log)) == pytest.approx([0.028] * 3, rel=0.1)


def test_a_recording_is_no_finer_than_its_resolution() -> None:
    signal, log = recording(0.0, step=0.5)
    assert signal_step(signal) == pytest.approx([0.5] * 3)
    assert (instrument_noise(signal, motion_of(log)) > 0.14).all()
    assert signal_step(np.random.default_rng(0).normal(size=(500, 2))).tolist() == [0, 0]


def test_white_noise_is_white_and_a_ripple_is_not() -> None:
    rng, t = np.random.default_rng(1), np.arange(600) * 0.1
    false = 0
    for _ in range(200):
        false += not _portmanteau(rng.normal(0, 1, (600, 6)), 1.0).white
    assert false <= 2
    ripple = rng.normal(0, 1, (600, 6))
    ripple[:, 2] += 3 * np.sin(2.1 * t)
    test = _portmanteau(ripple, 1.0)
    assert not test.white
    assert test.p_value < 1e-6
    assert test.excess == pytest.approx(3 / np.sqrt(2) / np.sqrt(6), rel=0.2)
    # as surely correlated, and of no account beside the floor
    assert _portmanteau(ripple, 30.0).white


def test_every_row_is_fitted_and_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(whole, "MAX_SAMPLES", {**whole.MAX_SAMPLES, "position": 60})
    drawn = small.session_of(1, small.Plan(poses=400))
    metrology = Metrology(registered=True, sigma=small.SIGMA)
    log = small.log_of(drawn, small.readings(small.REAL["axial_compliance"], drawn, 1))
    (channel,) = diagnose(small.model_of(), log, metrology).channels
    few = log.select(thinning.drawn(np.zeros(400), 60))
    (searched,) = diagnose(small.model_of(), few, metrology).channels
    assert channel.samples == len(channel.gap) == 400
    (cause,), (before,) = channel.causes, searched.causes
    (value,), (rough,) = cause.parameters, before.parameters
    assert abs(value.value - 4e-6) < 4 * value.std
    assert value.std < 0.6 * rough.std
    assert channel.held_out is not None
    assert len(channel.held_out) > 380
    assert noise_floor(channel.selection, False).rms == pytest.approx(small.FLOOR, rel=0.06)


def test_a_cause_that_few_rows_suggest_falls_by_all_of_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The searched rows have a slip that the others lack: every second row is off by it."""
    drawn = small.session_of(1, small.Plan(poses=200))
    position = small.readings(small.NOMINAL, drawn, 1)
    off = small.readings(small.REAL["joint_offset"], drawn, 1)
    taken = thinning.drawn(np.zeros(200), 60)
    position[taken] = off[taken]
    position[np.setdiff1d(np.arange(200), taken)[:60]] -= (off - small.readings(
        small.NOMINAL, drawn, 1))[np.setdiff1d(np.arange(200), taken)[:60]]  # fmt: skip
    monkeypatch.setattr(whole, "MAX_SAMPLES", {**whole.MAX_SAMPLES, "position": 60})
    metrology = Metrology(registered=True, sigma=small.SIGMA)
    (channel,) = diagnose(small.model_of(), small.log_of(drawn, position), metrology).channels
    assert not channel.causes
    by_all = (Check.SIGNIFICANT, Check.ALL_ROWS_GAIN)
    assert any(why.failed in by_all for _, why in channel.judgement.withdrawn)
