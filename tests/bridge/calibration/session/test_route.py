"""Paths of a moved arm: collision-free, through known poses, at rest in each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gapbridge.bridge.calibration.joints.link import PERIOD, write_move
from gapbridge.bridge.calibration.session.positioning import all_free, route
from gapbridge.core.arm import builtin_arm
from gapbridge.core.model import Model
from gapbridge.core.workspace.capsules import Box
from gapbridge.core.workspace.workspace import Workspace

BEGIN, END = np.array([-1.0, 0.0]), np.array([1.0, 0.0])
ABOVE, LEFT, RIGHT = np.array([0.0, 2.0]), np.array([-1.0, 1.5]), np.array([1.0, 1.5])


def outside_wall(q: np.ndarray) -> np.ndarray:
    """Return which points are outside a wall between BEGIN and END, one unit high."""
    return np.asarray((np.abs(q[:, 0]) > 0.3) | (q[:, 1] > 1.0), dtype=float)


def test_a_free_path_is_straight() -> None:
    assert route(outside_wall, LEFT, RIGHT, [ABOVE]) == []


def test_the_shortest_path_through_one_pose_is_taken() -> None:
    far = np.array([0.0, 9.0])
    (via,) = route(outside_wall, BEGIN, END, [far, np.array([0.1, 3.0])]) or []
    np.testing.assert_array_equal(via, [0.1, 3.0])


def test_two_via_poses_are_used_if_one_is_not_enough() -> None:
    via = route(outside_wall, BEGIN, END, [RIGHT, LEFT])
    assert via is not None
    np.testing.assert_array_equal(via, [LEFT, RIGHT])


def test_no_path_is_returned_if_no_via_pose_helps() -> None:
    assert route(outside_wall, BEGIN, END, [LEFT]) is None
    assert route(outside_wall, BEGIN, END, []) is None


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 50))
def test_a_path_round_a_pillar_is_collision_free(seed: int) -> None:
    pillar = Box((-1.5, -0.15, -1.0), (-0.5, 0.15, 1.0))  # where the arm points
    space = Workspace.of(Model(builtin_arm("ur10e")), keep_out=(pillar,), floor=0.0)

    def clear(q: np.ndarray) -> np.ndarray:
        return space.clear(q).astype(float)

    random = np.random.default_rng(seed)
    begin = np.array([-0.6, -1.0, 1.2, -1.8, -1.5, 0.0])
    end = begin * [-1, 1, 1, 1, 1, 1]
    drawn = space.draw(60, random)
    via = route(clear, begin, end, list(drawn[space.clear(drawn)]))
    assert via != []
    if via is not None:
        way = np.vstack([begin, *via, end])
        assert all_free(clear, way[:-1], way[1:]).all()


def test_the_arm_stops_at_every_via_pose(tmp_path: Path) -> None:
    stops = [np.zeros(6), np.full(6, 0.5), np.array([0.5, -1, 0, 0, 0, 0])]
    length = write_move(tmp_path / "move.csv", stops, 0.4)
    table = np.loadtxt(tmp_path / "move.csv", delimiter=",", skiprows=1)
    speed = np.diff(table[:, 1:], axis=0) / PERIOD
    assert length == table[-1, 0]
    assert np.abs(speed).max() <= 0.4 + 1e-9
    at = int(np.argmin(np.abs(table[:, 1:] - 0.5).max(axis=1)))
    np.testing.assert_allclose(table[at, 1:], 0.5, atol=1e-9)
    assert np.abs(speed[at]).max() < 1e-3
    np.testing.assert_allclose(table[-1, 1:], stops[-1], atol=1e-12)
