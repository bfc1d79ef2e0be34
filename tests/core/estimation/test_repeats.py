"""Errors that repeats of a pose share make a fit less sure: by as much as fits really scatter."""

from __future__ import annotations

import numpy as np
import pytest

from gapbridge.core.estimation.linear_system import Bounds, System, joint_covariance

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
