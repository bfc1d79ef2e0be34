"""Regions of joint space, beside the k-means of scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.cluster.vq import kmeans2

from gapbridge.core.estimation.regions import joint_regions, k_means


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("repeats", [1, 3])
def test_clusters_are_those_of_scipy(seed: int, repeats: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.repeat(rng.uniform(-2, 2, (int(rng.integers(30, 200)), 6)), repeats, axis=0)
    count = int(rng.integers(2, 25))
    scipys = kmeans2(points, count, minit="++", seed=seed, iter=30)[1]
    assert np.array_equal(k_means(points, count, seed, rounds=30), scipys)


def test_repeats_of_a_pose_lie_in_one_region() -> None:
    q = np.repeat(np.random.default_rng(1).uniform(-2, 2, (40, 6)), 3, axis=0)
    region = joint_regions(q, 8).reshape(40, 3)
    assert (region == region[:, :1]).all()
    assert set(region.ravel()) == set(range(8))
