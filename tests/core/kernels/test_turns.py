"""Rotation vectors of many matrices: those of core.rotation."""

from __future__ import annotations

import numpy as np

from gapbridge.core.kernels.turns import rotation_vectors
from gapbridge.core.rotation import rotation_matrix, rotation_vector


def test_many_are_those_of_the_one_way_small_half_and_any_turns():
    rng = np.random.default_rng(0)
    axis = rng.normal(size=(4000, 3))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    angle = np.concatenate([
        rng.uniform(0, np.pi, 2000), 10.0 ** rng.uniform(-16, -1, 1000),
        np.pi - 10.0 ** rng.uniform(-12, -1, 1000),
    ])  # fmt: skip
    R = rotation_matrix(np.vstack([axis * angle[:, None], np.zeros((1, 3)), np.pi * np.eye(3)]))
    found = np.empty((len(R), 3))
    rotation_vectors(R, found)
    np.testing.assert_allclose(found, rotation_vector(R), rtol=0, atol=2e-15)
