"""AP and RP as ISO 9283 defines them, against figures worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hand_made import hand_made
from hypothesis import given, settings
from hypothesis import strategies as st

from gapbridge.core.calibration.budget.pose_accuracy import pose_accuracies
from gapbridge.core.estimation.registration import Registration
from gapbridge.core.rotation import rotation_matrix, rotation_vector

MM = 1e-3


def test_a_worked_example_gives_the_standards_figures():
    # four visits at the corners of a square of 2 mm around a place 3 mm off in x: every one is
    # sqrt(2) mm from their mean, so that S is 0 and RP is sqrt(2) mm
    error = np.array([[4, 1, 0], [4, -1, 0], [2, 1, 0], [2, -1, 0]]) * MM
    (found,) = pose_accuracies(hand_made(error, pose=[0] * 4))
    assert found.visits == 4
    assert found.after == pytest.approx([3 * MM, 0, 0], abs=1e-12)
    assert found.accuracy[1] == pytest.approx(3 * MM)
    assert found.repeatability == pytest.approx(np.sqrt(2) * MM)


def test_three_standard_deviations_of_the_distances_are_added():
    # on a line at -3, 0, 0, 3 mm: distances 3, 0, 0, 3, their mean 1.5, S = sqrt(4 * 1.5**2 / 3)
    error = np.array([[-3.0, 0, 0], [0, 0, 0], [0, 0, 0], [3, 0, 0]]) * MM
    (found,) = pose_accuracies(hand_made(error, pose=[0] * 4))
    assert found.mean_distance == pytest.approx(1.5 * MM)
    assert found.deviation == pytest.approx(np.sqrt(3) * MM)
    assert found.repeatability == pytest.approx((1.5 + 3 * np.sqrt(3)) * MM)


def test_accuracy_before_is_against_the_nominal_model():
    error = np.zeros((3, 3))
    before = np.tile([0.0, -2 * MM, 0.0], (3, 1))
    (found,) = pose_accuracies(hand_made(error, pose=[5] * 3, before=before))
    assert found.pose == 5
    assert found.before == pytest.approx([0, -2 * MM, 0])
    assert found.accuracy == pytest.approx((2 * MM, 0.0), abs=1e-12)


def test_single_visits_and_outlier_ones_are_left_out():
    error = np.zeros((5, 3))
    assert pose_accuracies(hand_made(error)) == ()
    outlier = replace(hand_made(error, pose=[0, 0, 1, 1, 1]), outliers=np.array([0]))
    (found,) = pose_accuracies(outlier)
    assert (found.pose, found.visits) == (1, 3)


def test_visits_from_the_other_side_are_another_pose():
    error = np.array([[1.0, 0, 0], [1, 0, 0], [-1, 0, 0], [-1, 0, 0]]) * MM
    approach = np.repeat([[1.0], [-1.0]], 2, axis=0) * np.ones(6)
    found = pose_accuracies(hand_made(error, pose=[0] * 4, approach=approach))
    assert [p.visits for p in found] == [2, 2]
    assert [p.repeatability for p in found] == pytest.approx([0, 0], abs=1e-9)


def test_what_a_hand_made_of_the_command_is_no_repeatability():
    q = np.tile([0.3, -1.2, 1.4, -1.0, -1.5, 0.4], (4, 1))
    q[:, 0] += [0, 2e-3, -1e-3, 1e-3]
    (found,) = pose_accuracies(hand_made(np.zeros((4, 3)), pose=[0] * 4, q=q))
    assert found.steered
    assert found.repeatability < 1e-12


def test_angles_repeat_within_three_deviations_about_each_axis():
    # about x, the flange is off by 3, -1, 3, -1 mrad: 1 in the mean, 2 around it
    off = np.outer([3e-3, -1e-3, 3e-3, -1e-3], [1.0, 0, 0])
    plain = hand_made(np.zeros((4, 3)), pose=[0] * 4)
    rotation = plain.model.predict(plain.readings.q).rotation
    turn = rotation_vector(rotation_matrix(off) @ rotation)
    (found,) = pose_accuracies(hand_made(np.zeros((4, 3)), pose=[0] * 4, kind="pose", turn=turn))
    assert found.turn == pytest.approx([1e-3, 0, 0], abs=1e-9)
    assert found.angles == pytest.approx([3 * 2e-3 * np.sqrt(4 / 3), 0, 0], abs=1e-9)


def test_instruments_that_show_no_place_have_neither():
    assert pose_accuracies(hand_made(np.zeros((4, 3)), pose=[0] * 4, kind="distance")) == ()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_where_the_instrument_stands_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    error = rng.normal(0, 1e-4, (6, 3))
    frame = Registration(rotation_matrix(rng.normal(size=3)), rng.normal(size=3))
    (here,) = pose_accuracies(hand_made(error, pose=[0] * 6))
    (there,) = pose_accuracies(hand_made(error, pose=[0] * 6, frame=frame))
    assert there.repeatability == pytest.approx(here.repeatability, rel=1e-6)
    assert there.after == pytest.approx(here.after, abs=1e-12)
