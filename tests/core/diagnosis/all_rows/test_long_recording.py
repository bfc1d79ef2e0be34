"""A recording too long for memory: searched in an excerpt, every row judged block by block."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from gapbridge.bridge.document.findings import finding_text
from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.all_rows import long_recording as blocks
from gapbridge.core.diagnosis.all_rows.row_sums import rows_of
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.dynamics import predict_torque, with_pieces
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import motion_of

COUNT, RATE = 12_000, 250.0
DELAY, FRICTION = 8e-3, 4.0


@pytest.fixture(scope="module")
def recording() -> tuple[Model, Log]:
    rng = np.random.default_rng(3)
    t = np.arange(COUNT) / RATE
    frequency, phase = rng.uniform(0.1, 0.4, (4, 6)), rng.uniform(0, 6, (4, 6))
    middle = np.array([0.0, -1.5, 1.5, -1.8, -1.5, 0.0])

    def path_at(late: float) -> np.ndarray:
        angle = 2 * np.pi * frequency * (t[:, None, None] - late) + phase
        return middle + np.sum(0.2 * np.sin(angle), axis=1)

    target, q = path_at(0.0), path_at(0.0)
    q[:, 1] = path_at(DELAY)[:, 1]
    model = Model(builtin_arm("ur10e"))
    columns = {"timestamp": t, "target_q": target, "actual_q": q + rng.normal(0, 1e-5, q.shape)}
    motion = motion_of(Log("rubbing.csv", columns, 6))
    torque = predict_torque(model, with_pieces(model, motion))
    torque[:, 0] += FRICTION * np.sign(np.gradient(q[:, 0]))
    torque += rng.normal(0, 0.3, torque.shape)
    torque[4321, 2] += 40.0
    return model, Log("rubbing.csv", columns | {"actual_current_as_torque": torque}, 6)


@pytest.fixture(scope="module")
def both(recording):
    """Return the diagnosis of the recording as a whole, and block by block."""
    model, log = recording
    whole = diagnose(model, log)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blocks, "WHOLE", 8000)
        patch.setattr(blocks, "EXCERPT", 6000)
        patch.setattr(blocks, "DERIVED", 3000)
        return whole, diagnose(model, log)


def test_blocks_hold_every_row_once(recording, monkeypatch):
    monkeypatch.setattr(blocks, "WHOLE", 8000)
    _, log = recording
    long = blocks.long_recording(log)
    assert long is not None
    found = list(long)
    assert found[0].begin == 0
    assert found[-1].end == COUNT
    assert all(one.end == other.begin for one, other in pairwise(found))
    whole = motion_of(log)
    for block in found[5:-5:20]:
        motion, rows = motion_of(block.log), slice(block.first, block.end)
        np.testing.assert_array_equal(motion.t, whole.t[rows])
        typical = np.abs(whole.qdd).mean()
        np.testing.assert_allclose(motion.qdd, whole.qdd[rows], atol=0.3 * typical)


def test_a_short_recording_is_looked_at_as_a_whole(recording):
    assert blocks.long_recording(recording[1]) is None


@pytest.mark.slow
def test_blocks_find_what_the_whole_shows(both):
    for one, other in zip(*(found.channels for found in both), strict=True):
        assert one.channel == other.channel
        assert [c.effect for c in one.causes] == [c.effect for c in other.causes]
        assert other.samples == pytest.approx(one.samples, rel=0.02)
        assert other.gap_rms == pytest.approx(one.gap_rms, rel=0.01)
        assert other.remaining_rms == pytest.approx(one.remaining_rms, rel=0.02)
        assert other.remaining_rms_held_out == pytest.approx(one.remaining_rms_held_out, rel=0.02)
        assert other.generalisation.new_region == pytest.approx(
            one.generalisation.new_region, rel=0.02
        )
        for own, its in zip(one.causes, other.causes, strict=True):
            for a, b in zip(own.parameters, its.parameters, strict=True):
                assert b.value == pytest.approx(a.value, abs=3 * a.std)
                assert b.std == pytest.approx(a.std, rel=0.2)


@pytest.mark.slow
def test_an_outlier_outside_the_excerpt_is_excluded_and_named(both):
    _, found = both
    torque = next(c for c in found.channels if c.channel == "torque")
    assert 4321 in torque.outliers
    assert any("row 4323" in finding_text(f) for f in found.findings)


def test_rows_from_sums_have_the_same_sums():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(50, 4)) @ np.diag([1.0, 1e-3, 1e3, 0.0])
    R = rows_of(A.T @ A)
    np.testing.assert_allclose(R.T @ R, A.T @ A, rtol=1e-9, atol=1e-12)


def test_a_channel_with_few_rows_of_a_long_recording_is_judged_on_all(recording, monkeypatch):
    """The excerpt's rows are few enough to be searched at once, with unnamed functions."""
    monkeypatch.setattr(blocks, "WHOLE", 8000)
    monkeypatch.setattr(blocks, "EXCERPT", 6000)
    model, log = recording
    torque = log.columns["actual_current_as_torque"].copy()
    torque[:, 3] += 2.0 * np.sin(3 * log.columns["actual_q"][:, 3] ** 2)  # in no catalogue
    torque[np.arange(COUNT) % 25 > 0] = np.nan
    few = Log("few.csv", log.columns | {"actual_current_as_torque": torque}, 6)
    found = next(c for c in diagnose(model, few).channels if c.channel == "torque")
    assert 300 < found.samples <= COUNT / 25  # without those where a joint reverses
    assert [c.effect for c in found.causes][:1] == ["coulomb_friction"]
    assert found.structured


@pytest.mark.slow
def test_a_pause_changes_no_interval(recording, monkeypatch):
    """Beside an unknown part intervals come from stretches of time, and a pause is none."""
    monkeypatch.setattr(blocks, "WHOLE", 8000)
    monkeypatch.setattr(blocks, "EXCERPT", 6000)
    monkeypatch.setattr(blocks, "DERIVED", 3000)
    model, log = recording
    torque = log.columns["actual_current_as_torque"].copy()
    torque[:, 3] += 2.0 * np.sin(3 * log.columns["actual_q"][:, 3] ** 2)  # in no catalogue
    found = []
    for pause in (0.0, 3600.0):
        t = log.columns["timestamp"] + pause * (np.arange(COUNT) >= 5000)
        columns = log.columns | {"timestamp": t, "actual_current_as_torque": torque}
        long = diagnose(model, Log("paused.csv", columns, 6))
        found.append(next(c for c in long.channels if c.channel == "torque"))
    one, other = found
    assert one.structured and other.structured
    assert [(c.effect, c.joints) for c in other.causes] == [
        (c.effect, c.joints) for c in one.causes
    ]
    for own, its in zip(one.causes, other.causes, strict=True):
        for a, b in zip(own.parameters, its.parameters, strict=True):
            assert b.value == pytest.approx(a.value, abs=a.std)
            assert b.std == pytest.approx(a.std, rel=0.3)
