"""Rotation maps against scipy and against themselves, near zero and near half a turn too."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from gapbridge.core.rotation import (
    left_jacobian,
    one_rotation_matrix,
    roll_pitch_yaw,
    rotation_matrix,
    rotation_vector,
    rpy_matrix,
    skew,
    transform,
)

number = st.floats(-3, 3)
vectors = arrays(float, 3, elements=number)
axes = vectors.filter(lambda v: np.linalg.norm(v) > 1e-3).map(lambda v: v / np.linalg.norm(v))
angles = st.one_of(
    st.floats(0, np.pi),
    st.floats(0, 1e-6),
    st.sampled_from([0.0, 1e-300, 1e-160, 1e-12, 1e-8, np.pi / 2]),
    st.floats(0, 1e-6).map(lambda x: np.pi - x),
)


@given(axes, angles)
def test_a_rotation_vector_gives_scipys_matrix(axis, angle):
    expected = Rotation.from_rotvec(angle * axis).as_matrix()
    np.testing.assert_allclose(rotation_matrix(angle * axis), expected, atol=1e-14)


@given(axes, angles)
def test_there_and_back_is_the_same_rotation_vector(axis, angle):
    back = rotation_vector(rotation_matrix(angle * axis))
    near = np.linalg.norm(back - angle * axis)
    if np.pi - angle < 1e-7:  # at half a turn both directions are right
        near = min(near, np.linalg.norm(back + angle * axis))
    assert near < 1e-7 if angle > 3 else near < 1e-14 + 1e-12 * angle


@given(axes, angles)
def test_the_angle_is_never_more_than_half_a_turn_and_never_nan(axis, angle):
    R = rotation_matrix(2 * angle * axis)
    back = rotation_vector(R)
    assert np.linalg.norm(back) <= np.pi + 1e-12
    np.testing.assert_allclose(rotation_matrix(back), R, atol=1e-12)


@given(st.floats(1e-15, 1e-5), axes)
def test_small_rotations_keep_all_their_digits(angle, axis):
    back = rotation_vector(rotation_matrix(angle * axis))
    # the matrix itself rounds the products at 1e-16
    np.testing.assert_allclose(back, angle * axis, atol=3e-16, rtol=1e-9)


@given(vectors, vectors)
def test_matrices_are_proper_rotations_and_skew_is_the_cross_product(a, b):
    R = rotation_matrix(a)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-13)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-14)


@given(vectors)
def test_fixed_axis_angles_are_urdfs(angles):
    expected = Rotation.from_euler("xyz", angles).as_matrix()
    np.testing.assert_allclose(rpy_matrix(angles), expected, atol=1e-14)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_many_at_once_are_the_ones_alone(shape):
    rng = np.random.default_rng(1)
    many = rng.uniform(-2, 2, (*shape, 3))
    R = rotation_matrix(many)
    assert R.shape == (*shape, 3, 3)
    back = rotation_vector(R)
    assert back.shape == (*shape, 3)
    for index in np.ndindex(shape):
        np.testing.assert_array_equal(R[index], rotation_matrix(many[index]))
        np.testing.assert_array_equal(back[index], rotation_vector(R[index]))


@pytest.mark.parametrize("axis", np.eye(3))
def test_exactly_half_a_turn_about_each_axis_is_known(axis):
    R = 2 * np.outer(axis, axis) - np.eye(3)
    np.testing.assert_allclose(np.abs(rotation_vector(R)), np.pi * axis, atol=1e-15)


def test_a_transform_turns_first_and_shifts_then():
    T = transform(rotation_matrix(np.array([0, 0, np.pi / 2])), np.array([1.0, 2, 3]))
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-15)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-8, 1e-3, 1.0, np.pi, 10.0])
def test_one_matrix_in_plain_numbers_is_that_of_many(size):
    rng = np.random.default_rng(2)
    for _ in range(20):
        vector = size * rng.normal(size=3)
        np.testing.assert_allclose(
            one_rotation_matrix(vector), rotation_matrix(vector), rtol=0, atol=1e-14
        )


@given(st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_the_left_jacobian_is_what_one_more_radian_turns(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vector = rng.normal(size=3)
    vector *= rng.choice([1e-5, 1e-2, 1.0, 3.0]) / np.linalg.norm(vector)
    before = Rotation.from_rotvec(vector)
    for k, step in enumerate(1e-6 * np.eye(3)):
        ahead, behind = (Rotation.from_rotvec(vector + way * step) for way in (1, -1))
        turn = ((ahead * before.inv()).as_rotvec() - (behind * before.inv()).as_rotvec()) / 2e-6
        np.testing.assert_allclose(left_jacobian(vector)[:, k], turn, atol=1e-7)


@given(st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_roll_pitch_and_yaw_are_about_fixed_axes(seed: int) -> None:
    rotation = Rotation.random(random_state=seed)
    found = roll_pitch_yaw(rotation.as_matrix())
    np.testing.assert_allclose(found, rotation.as_euler("xyz"), atol=1e-9)
    np.testing.assert_allclose(rpy_matrix(found), rotation.as_matrix(), atol=1e-12)
