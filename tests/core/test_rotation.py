"""Rotations against scipy's, from nothing to half a turn."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from core.rotation import rotation_matrix, rotation_vector, rpy_matrix, skew, transform

vectors = arrays(float, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 1e-3)
angles = st.one_of(st.floats(0, np.pi), st.floats(0, 1e-6), st.floats(np.pi - 1e-6, np.pi))


@given(vectors, angles)
@settings(max_examples=300, deadline=None)
def test_matrices_are_scipys(axis, angle):
    vector = axis / np.linalg.norm(axis) * angle
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation_matrix(vector), expected, atol=1e-14)


@given(vectors, angles)
@settings(max_examples=300, deadline=None)
def test_a_vector_comes_back_from_its_matrix(axis, angle):
    vector = axis / np.linalg.norm(axis) * angle
    R = Rotation.from_rotvec(vector).as_matrix()
    back = rotation_vector(R)
    assert np.linalg.norm(back) <= np.pi + 1e-12
    # at half a turn v and -v are the same rotation
    np.testing.assert_allclose(Rotation.from_rotvec(back).as_matrix(), R, atol=1e-13)
    if angle < np.pi - 1e-7:
        np.testing.assert_allclose(back, vector, atol=1e-8 if angle > 3 else 1e-13)


@pytest.mark.parametrize("axis", [*np.eye(3), [1, 1, 0], [0, 1, 1], [1, 1, 1]])
def test_half_a_turn_about_any_axis_is_told(axis):
    vector = np.asarray(axis, float) / np.linalg.norm(axis) * np.pi
    R = Rotation.from_rotvec(vector).as_matrix()
    assert np.linalg.norm(rotation_vector(R)) == pytest.approx(np.pi)
    assert abs(abs(rotation_vector(R) @ vector) - np.pi**2) < 1e-6


def test_no_rotation_is_the_zero_vector():
    np.testing.assert_array_equal(rotation_vector(np.eye(3)), 0)
    np.testing.assert_array_equal(rotation_matrix(np.zeros(3)), np.eye(3))


def test_a_tiny_rotation_keeps_its_digits():
    vector = np.array([1e-12, -2e-12, 3e-12])
    np.testing.assert_allclose(rotation_vector(rotation_matrix(vector)), vector, rtol=1e-9)


def test_many_rows_are_done_at_once():
    vector = np.random.default_rng(0).uniform(-1, 1, (4, 5, 3))
    R = rotation_matrix(vector)
    assert R.shape == (4, 5, 3, 3)
    np.testing.assert_allclose(rotation_vector(R), vector, atol=1e-13)


def test_skew_is_the_cross_product():
    a, b = np.random.default_rng(1).normal(size=(2, 6, 3))
    np.testing.assert_allclose((skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)


def test_roll_pitch_yaw_turn_about_fixed_axes():
    angles = np.array([0.3, -0.7, 2.1])
    np.testing.assert_allclose(
        rpy_matrix(angles), Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-15
    )


def test_a_transform_carries_rotation_and_position():
    R = rpy_matrix(np.array([0.1, 0.2, 0.3]))
    T = transform(R, np.array([1.0, 2, 3]))
    point = T @ [0.5, 0, 0, 1]
    np.testing.assert_allclose(point[:3], R @ [0.5, 0, 0] + np.array([1, 2, 3]))
    assert point[3] == 1
