"""Folds beside scipy's k-means, and fits that left a part out beside fits of the other rows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.cluster.vq import kmeans2

from gapbridge.core.estimation.held_out import (
    held_out_residual,
    jackknife,
    joint_regions,
    k_means,
    leave_one_out,
    random_folds,
)


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


def test_rows_of_a_group_share_a_fold_and_folds_are_even() -> None:
    groups = np.repeat(np.arange(3, 43), 4)[::-1]
    fold = random_folds(groups, 8)
    assert all(len(set(fold[groups == g])) == 1 for g in np.unique(groups))
    assert np.bincount(fold).tolist() == [20] * 8
    assert set(random_folds(np.array([5, 9, 9]), 8)) == {0, 1}


def test_fits_that_left_a_part_out_are_those_of_the_other_rows() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(40, 3)) * [1.0, 1e-4, 1e3]
    b, part = rng.normal(size=40), np.arange(30) % 4  # ten rows are in every fit
    found = list(leave_one_out(A, b, part))
    assert len(found) == 4
    for k, (out, x) in enumerate(found):
        assert out.tolist() == np.flatnonzero(part == k).tolist()
        rest = np.setdiff1d(np.arange(40), out)
        np.testing.assert_allclose(x, np.linalg.lstsq(A[rest], b[rest], rcond=None)[0], rtol=1e-7)


def test_what_holds_a_number_holds_it_in_every_fit() -> None:
    rng = np.random.default_rng(2)
    A, b = rng.normal(size=(30, 2)), rng.normal(size=30)
    A[:, 1] = 0.0
    part, hold = np.arange(30) % 5, np.array([4.0, 0.1])
    left = held_out_residual(A, b, part, hold)
    for k in range(5):
        rest, own = part != k, part == k
        x = A[rest, 0] @ b[rest] / (A[rest, 0] @ A[rest, 0] + 16.0)
        np.testing.assert_allclose(left[own], b[own] - A[own, 0] * x, rtol=1e-9)


def test_the_jackknife_of_means_is_the_variance_of_a_mean() -> None:
    values = np.random.default_rng(3).normal(size=12)
    without = np.array([[np.delete(values, i).mean()] for i in range(12)])
    assert jackknife(without)[0, 0] == pytest.approx(values.var(ddof=1) / 12)
