"""The instrument's frame: exact data, mirrored and flat ones, weights, outliers, small steps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gapbridge.core.estimation.registration import (
    Registration,
    frame_columns,
    register,
    register_robustly,
)

Drawn = tuple[Registration, np.ndarray, np.ndarray]


def drawn(seed: int, count: int = 12) -> Drawn:
    """Return a frame, positions in base, and the same in the instrument's frame."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    frame = Registration(rotation, rng.uniform(-2.0, 2.0, 3))
    position = rng.uniform(-1.0, 1.0, (count, 3))
    return frame, position, position @ rotation.T + frame.position


def off_by(found: Registration, frame: Registration) -> float:
    return float(
        np.abs(found.rotation - frame.rotation).max()
        + np.abs(found.position - frame.position).max()
    )


@given(st.integers(0, 10_000), st.booleans())
@settings(max_examples=60, deadline=None)
def test_exact_positions_give_their_frame_even_in_a_plane(seed: int, flat: bool) -> None:
    frame, position, _ = drawn(seed)
    if flat:
        position[:, 2] = 0.3
    measured = position @ frame.rotation.T + frame.position
    found = register(measured, position)
    assert off_by(found, frame) < 1e-9
    np.testing.assert_allclose(found.in_base(measured), position, atol=1e-9)
    turned = Rotation.random(len(position), random_state=seed).as_matrix()
    np.testing.assert_allclose(found.rotation_in_base(frame.rotation @ turned), turned, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_mirrored_positions_get_a_rotation_and_no_reflection(seed: int) -> None:
    _, position, measured = drawn(seed)
    found = register(measured * [1.0, 1.0, -1.0], position)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(5))
def test_positions_of_no_weight_move_neither_turn_nor_origin(seed: int) -> None:
    frame, position, measured = drawn(seed)
    weights = np.ones(len(position))
    weights[:3] = 0.0
    measured[:3] += [0.5, -0.2, 0.1]
    assert off_by(register(measured, position, weights), frame) < 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_a_fifth_of_outliers_hardly_moves_the_robust_frame(seed: int) -> None:
    frame, position, measured = drawn(seed, 40)
    rng = np.random.default_rng(seed)
    measured += rng.normal(0.0, 1e-4, measured.shape)
    good = off_by(register(measured, position), frame)
    measured[:8] += [0.05, 0.03, -0.04]
    assert off_by(register(measured, position), frame) > 20 * good
    assert off_by(register_robustly(measured, position), frame) < 3 * good


@pytest.mark.parametrize("seed", range(5))
def test_a_step_of_the_frame_does_what_its_columns_predict(seed: int) -> None:
    frame, position, measured = drawn(seed)
    turned = Rotation.random(len(position), random_state=seed)
    seen = frame.rotation @ turned.as_matrix()
    step = np.random.default_rng(seed).normal(0.0, 1e-5, 6)
    moved = frame.moved(step)
    predicted = frame_columns(position) @ step
    np.testing.assert_allclose(
        moved.in_base(measured) - position, predicted[:, :3], atol=1e-8, rtol=0
    )
    turn = Rotation.from_matrix(moved.rotation_in_base(seen)) * turned.inv()
    np.testing.assert_allclose(turn.as_rotvec(), predicted[:, 3:], atol=1e-8, rtol=0)
