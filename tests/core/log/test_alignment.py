"""A simulator's rows at the rows of a measured log: by time, and of the same motion."""

from __future__ import annotations

import numpy as np
import pytest

from gapbridge.core.errors import LogError
from gapbridge.core.log.alignment import aligned
from gapbridge.core.log.log import Log

T = np.arange(0.0, 2.0, 0.01)


def moving(t: np.ndarray, clock: float = 0.0, **more: np.ndarray) -> Log:
    q = np.column_stack([np.sin(t), np.cos(t)])
    position = np.column_stack([t, 2 * t, 3 * t])
    return Log(
        "sim.csv", {"timestamp": t + clock, "target_q": q, "measured_position": position, **more}, 2
    )


def test_rows_of_one_time_go_together_whatever_their_order_and_rate() -> None:
    log = moving(T[10:150:7] + 0.003)
    found = aligned(moving(T[::-1]), log)
    np.testing.assert_allclose(
        found.columns["measured_position"], log.columns["measured_position"], atol=1e-12
    )
    np.testing.assert_allclose(found.columns["timestamp"], log.columns["timestamp"])


def test_poses_are_never_interpolated() -> None:
    log, slow = moving(np.arange(10.0)), moving(np.arange(9, -1, -1.0))
    found = aligned(slow, log)
    np.testing.assert_array_equal(
        found.columns["measured_position"], log.columns["measured_position"]
    )
    with pytest.raises(
        LogError, match=r"sim.csv: timestamp: found no row for row 2 of sim.csv at 0.3 s"
    ):
        aligned(slow, moving(np.arange(9.0) + 0.3))


def test_clocks_that_differ_by_a_constant_are_one() -> None:
    log = moving(T, clock=1.7e9)
    assert aligned(moving(T), log).columns["measured_position"] is not None
    with pytest.raises(LogError, match="found no row for row 2"):
        aligned(moving(T[5:]), log)


def test_without_time_row_goes_with_row() -> None:
    log, bare = moving(T), moving(T)
    del bare.columns["timestamp"]  # type: ignore[attr-defined]
    assert aligned(bare, log) is bare
    with pytest.raises(LogError, match=r"found 200 rows, expected 199: one per row"):
        aligned(bare, moving(T[1:]))


def test_another_motion_is_refused_by_joint_and_row() -> None:
    other = moving(T)
    other.columns["target_q"][7, 1] += 0.02
    with pytest.raises(LogError, match=r"sim.csv: joint 2 \(target_q_1\): found .* where row 9 of"):
        aligned(other, moving(T))


def test_a_urs_own_pose_is_the_simulated_position() -> None:
    pose = np.column_stack([T, T, T, 0 * T, 0 * T, 0 * T]) + 1
    simulated = moving(T, actual_TCP_pose=pose)
    log = moving(T)
    np.testing.assert_array_equal(
        aligned(simulated, log).columns["measured_position"], log.columns["measured_position"]
    )
    del simulated.columns["measured_position"]  # type: ignore[attr-defined]
    found = aligned(simulated, log).columns
    np.testing.assert_array_equal(found["measured_position"], pose[:, :3])
    np.testing.assert_array_equal(found["measured_rotation"], pose[:, 3:])


def test_a_simulator_may_count_angles_on_another_turn() -> None:
    log, simulated = moving(T), moving(T)
    simulated.columns["target_q"][50:] += 2 * np.pi
    found = aligned(simulated, log)
    np.testing.assert_allclose(found.columns["target_q"], log.columns["target_q"], atol=1e-12)


def test_a_rotation_that_a_row_lacks_is_missing_there_alone() -> None:
    turned = np.column_stack([0.1 * T, 0 * T, 0 * T])
    turned[52] = np.nan
    log = moving(T[10:150:7] + 0.003)
    found = aligned(moving(T, measured_rotation=turned), log).columns["measured_rotation"]
    lost = np.abs(log.columns["timestamp"] - T[52]) < 0.01
    assert lost.any()
    assert np.isnan(found[lost]).all()
    np.testing.assert_allclose(found[~lost, 0], 0.1 * log.columns["timestamp"][~lost], atol=1e-9)
