"""Rotations of the kernels beside scipy's, where both ways of computing them meet too."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapbridge.core.kernels import reference

AXIS = np.array([0.36, -0.48, 0.8])


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 9.9e-5, 1.01e-4, 1e-3, 1.0, 3.0])
def test_a_bending_turns_as_its_rotation_vector_says(angle: float) -> None:
    found = np.empty((3, 3))
    reference._turn(*(angle * AXIS), found)
    expected = Rotation.from_rotvec(angle * AXIS).as_matrix()
    assert np.abs(found - expected).max() < 1e-15
