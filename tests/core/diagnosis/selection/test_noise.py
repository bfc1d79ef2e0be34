"""Noise: the instrument's and the arm's are separated, and whitening makes gaps alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small

from gapbridge.core.diagnosis.channels.position import observe
from gapbridge.core.diagnosis.channels.recording import own_joints
from gapbridge.core.diagnosis.selection.noise import estimate_noise
from gapbridge.core.metrology import Metrology

SESSION = small.session_of(0, small.Plan(poses=120))
SEEN = observe(
    small.model_of(), small.log_of(SESSION, small.stand(small.NOMINAL, SESSION).tcp),
    Metrology(registered=True, sigma=1e-5),
)  # fmt: skip
KEPT = np.ones(120, dtype=bool)


def scattered(instrument: float, joint: float, seed: int = 0):
    """Return residuals (N, 3): noise of the instrument, and of the joints through their levers."""
    rng = np.random.default_rng(seed)
    shape = small.stand(small.NOMINAL, SESSION)
    lever = np.cross(shape.axes[..., 2], shape.tcp - shape.origin)
    shaken = np.einsum("jni,nj->ni", lever, rng.normal(0, joint, (120, 3)))
    return shaken + rng.normal(0, instrument, (120, 3))


@pytest.mark.parametrize(("instrument", "joint"), [(2e-5, 0.0), (2e-5, 8e-5), (1.2e-5, 2e-5)])
def test_both_sizes_are_recovered(instrument, joint):
    noise = estimate_noise(SEEN, scattered(instrument, joint), KEPT)
    assert noise.block_sigma[0] == pytest.approx(instrument, rel=0.35)
    if joint > instrument:
        assert noise.joint_sigma == pytest.approx(joint, rel=0.25)
    else:
        assert noise.joint_sigma < 3e-5


def test_whitened_noise_has_unit_size_in_every_coordinate():
    gap = scattered(2e-5, 8e-5, 3)
    white = (estimate_noise(SEEN, gap, KEPT).whitener @ gap[..., None])[..., 0]
    assert np.allclose(np.cov(white.T), np.eye(3), atol=0.35)


def test_the_stated_sigma_is_the_least_that_is_believed():
    noise = estimate_noise(SEEN, scattered(1e-7, 0.0), KEPT)
    assert noise.block_sigma[0] >= 1e-5
    assert noise.floor_share == pytest.approx(1, abs=0.05)
    whole = replace(SEEN, sigma=5e-5, sigma_is_whole=True)
    known = estimate_noise(whole, scattered(2e-5, 8e-5), KEPT)
    covariance = np.linalg.inv(known.whitener.transpose(0, 2, 1) @ known.whitener)
    assert np.sqrt(np.mean(np.einsum("nii->ni", covariance))) == pytest.approx(5e-5)


def test_readings_set_aside_do_not_count():
    gap, kept = scattered(2e-5, 0.0), KEPT.copy()
    gap[5] = 0.05
    kept[5] = False
    noise = estimate_noise(SEEN, gap, kept)
    assert noise.block_sigma[0] == pytest.approx(2e-5, rel=0.3)


@pytest.mark.parametrize("channel", ["torque", "tracking"])
def test_where_joints_are_coordinates_each_has_one_noise_of_its_own(channel):
    """A noise common to the joints beside one of each is a number too many for the data."""
    rng, size = np.random.default_rng(1), np.array([0.5, 0.2, 0.1])
    joints = replace(SEEN, channel=channel, sigma=0.0, joint_columns=own_joints(120, 3))
    noise = estimate_noise(joints, rng.normal(0, size, (120, 3)), KEPT)
    assert noise.block_sigma == pytest.approx(size, rel=0.2)
    assert noise.joint_sigma == 0


def test_the_step_of_the_encoders_is_the_least_noise_of_every_joint():
    size = np.array([3e-5, 1e-6, 4e-6])
    joints = replace(SEEN, channel="tracking", sigma=1e-5, joint_columns=own_joints(120, 3))
    noise = estimate_noise(joints, np.random.default_rng(2).normal(0, size, (120, 3)), KEPT)
    assert noise.block_sigma == pytest.approx([3e-5, 1e-5, 1e-5], rel=0.2)
    assert noise.block_sigma[1:] == pytest.approx(1e-5, rel=1e-9)
