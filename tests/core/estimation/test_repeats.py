"""Errors that repeats of a pose share make a fit less sure: by as much as fits really scatter."""

from __future__ import annotations

import numpy as np
import pytest

from gapbridge.core.arm import builtin_arm
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.estimation.linear_system import Bounds, System, joint_covariance
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.motion import time_stretches

POSES, REPEATS, WIDTH, NUMBERS = 20, 4, 3, 6


@pytest.mark.parametrize("shared", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("nuisances", [0, 2])
def test_covariances_are_those_of_fits_to_many_draws(shared: float, nuisances: int) -> None:
    rng = np.random.default_rng(4)
    count = POSES * REPEATS
    pose = np.repeat(np.arange(POSES), REPEATS)
    # half of what is fitted shows by pose alone, half by loads, which differ at each repeat
    A = rng.normal(size=(POSES, WIDTH, NUMBERS))[pose]
    A[:, :, ::2] = rng.normal(size=(count, WIDTH, NUMBERS // 2))
    A = A.reshape(count * WIDTH, NUMBERS)
    wide = np.full(NUMBERS - nuisances, 1e6)
    bounds = Bounds(-wide, wide, wide, 0 * wide)
    found, covariances = [], []
    for _ in range(300):
        common = rng.normal(size=(POSES, WIDTH))[pose]
        own = rng.normal(size=(count, WIDTH))
        e = (np.sqrt(shared) * common + np.sqrt(1 - shared) * own).ravel()
        x = np.linalg.lstsq(A, e, rcond=None)[0]
        split = NUMBERS - nuisances
        system = System(A[:, :split], A[:, split:], e - A @ x)
        found.append(x)
        covariances.append(np.diag(joint_covariance(system, bounds, pose)))
    ratio = np.sqrt(np.mean(covariances, axis=0)) / np.std(found, axis=0)
    np.testing.assert_allclose(ratio, 1.0, atol=0.12)


def test_readings_that_are_no_repeats_share_nothing() -> None:
    rng = np.random.default_rng(5)
    A, e = rng.normal(size=(30, 4)), rng.normal(size=30)
    wide = np.full(4, 1e6)
    system, bounds = System(A, A[:, :0], e), Bounds(-wide, wide, wide, 0 * wide)
    found = joint_covariance(system, bounds, np.arange(10))
    np.testing.assert_allclose(found, np.linalg.inv(A.T @ A), rtol=1e-6)


@pytest.mark.parametrize(("correlation", "least", "most"), [(0.0, 0.7, 1.5), (0.5, 2.0, 8.0)])
def test_neighbours_in_time_of_a_recording_share_their_errors(
    correlation: float, least: float, most: float
) -> None:
    rng, t = np.random.default_rng(6), np.arange(800) * 0.05
    tool = np.eye(4)
    tool[:3, 3] = 0.05, -0.04, 0.2
    model = Model(builtin_arm("ur10e"), tool)
    rate, phase = rng.uniform(0.3, 2, (2, 6)), rng.uniform(0, 6, (2, 6))
    q = [0, -1.2, 1.4, -1.7, -1.5, 0] + 0.4 * np.sin(rate * t[:, None, None] + phase).sum(axis=1)
    mass = np.where(t % 8 < 4, 0.0, 8.0)
    stay = np.exp(-0.05 / correlation) if correlation else 0.0
    error = rng.normal(0, 5e-5, (len(t), 3))
    for i in range(1, len(t)):
        error[i] = stay * error[i - 1] + np.sqrt(1 - stay**2) * error[i]
    real = model.with_compliance(np.full(6, 8e-6), np.full(6, 4e-6))
    measured = real.predict(q, Loads(payload_mass=mass)).position + error
    columns = {"actual_q": q, "payload": mass, "measured_position": measured}
    recorded, unordered = (
        identify_compliance(model, Log("log.csv", c, 6), Metrology(registered=True))
        for c in (columns | {"timestamp": t}, columns)
    )
    both = recorded.identifiable & unordered.identifiable
    std, as_poses = (np.append(f.std_axial, f.std_radial)[both] for f in (recorded, unordered))
    assert least < np.median(std / as_poses) < most


def test_stretches_of_time_leave_out_pauses_and_poses_at_rest_have_none() -> None:
    t = np.arange(400) * 0.02
    t[200:] += 60.0
    q = np.sin(t[:, None] + np.arange(6))
    recording = Log("log.csv", {"timestamp": t, "actual_q": q}, 6)
    stretch = time_stretches(recording, 4)
    assert stretch is not None
    np.testing.assert_allclose(np.bincount(stretch), 100, atol=2)
    at_rest = {"timestamp": t * 100, "actual_q": q}
    backwards = {"timestamp": t[::-1], "actual_q": q}
    for columns in (at_rest, backwards, {"actual_q": q}):
        assert time_stretches(Log("log.csv", columns, 6), 4) is None
