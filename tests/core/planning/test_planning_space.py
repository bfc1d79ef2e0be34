"""Where the arm may be measured: limits, boxes, the arm itself, and what the instrument sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import PlanError
from gapbridge.core.model import Model
from gapbridge.core.workspace.capsules import Box, segment_distance
from gapbridge.core.workspace.workspace import (
    Place,
    Reflector,
    Rejection,
    RejectionReason,
    Workspace,
)

UP = np.array([[0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0]])  # a UR stretched upwards
OUT = np.zeros((1, 6))  # a UR stretched out along -x


@pytest.fixture(scope="module")
def model() -> Model:
    tool = np.eye(4)
    tool[:3, 3] = [0.02, 0.0, 0.15]
    return Model(builtin_arm("ur5e"), tool)


def test_frames_are_the_rigid_models(model: Model) -> None:
    space = Workspace.of(model)
    q = space.draw(50, np.random.default_rng(0))
    frames, poses = space.frames(q), model.rigid_pose(q)
    assert frames.tcp == pytest.approx(poses.position, abs=1e-12)
    assert frames.rotation == pytest.approx(poses.rotation, abs=1e-12)


def test_joints_that_turn_further_than_once_round_need_not_wind_up(model: Model) -> None:
    space = Workspace.of(model)
    assert space.lower == pytest.approx(-np.pi)
    tight = Workspace.of(model, lower=[-1] * 6, upper=[0.5, 1, 1, 1, 1, 1])
    drawn = tight.draw(200, np.random.default_rng(0))
    assert drawn.min() >= -1
    assert drawn[:, 0].max() <= 0.5
    assert not tight.clear(np.full((1, 6), 0.9)).any()


def test_a_box_is_hit_by_the_arm_that_reaches_into_it(model: Model) -> None:
    tip = model.rigid_pose(OUT).position[0]
    box = Box(tuple(tip - 0.05), tuple(tip + 0.05))
    assert Workspace.of(model).clear(OUT).all()
    assert not Workspace.of(model, keep_out=[box]).clear(OUT).any()
    assert Workspace.of(model, keep_out=[box]).clear(UP).all()


def test_a_thin_wall_between_the_joints_is_seen(model: Model) -> None:
    wall = Box((-0.31, -1.0, 0.0), (-0.30, 1.0, 1.0))  # across the middle of the upper arm
    assert not Workspace.of(model, keep_out=[wall]).clear(OUT).any()


@pytest.mark.parametrize(("joint", "beside"), [(2, 0.1762), (3, 0.0393)])
def test_a_box_is_hit_by_a_link_that_stands_beside_the_line_between_its_joints(joint, beside):
    """``beside``: of the tubes of a UR10e, m, from the manufacturer's description of it."""
    model = Model(builtin_arm("ur10e"))
    rng = np.random.default_rng(0)
    for q in Workspace.of(model).draw(20, rng)[:, None]:
        frames = Workspace.of(model).frames(q)
        middle = frames.origin[0, joint : joint + 2].mean(axis=0)
        tube = middle + beside * frames.axis[0, joint - 1]
        space = Workspace.of(model, keep_out=[Box(tuple(tube - 0.02), tuple(tube + 0.02))])
        assert space.rejections(q)[Rejection(RejectionReason.BOX, 1)].all()


def test_the_floor_stops_the_forearm_and_not_the_foot(model: Model) -> None:
    space = Workspace.of(model, floor=0.0)
    assert space.clear(UP).all()
    down = np.array([[0.0, 0.6, 0.0, 0.0, 0.0, 0.0]])
    assert space.rejections(down)[Rejection(RejectionReason.FLOOR)].all()


def test_a_folded_arm_is_near_itself(model: Model) -> None:
    folded = np.array([[0.0, -np.pi / 2, np.pi - 0.15, 0.0, 0.5, 0.0]])
    assert Workspace.of(model).rejections(folded)[Rejection(RejectionReason.SELF)].all()


def test_the_load_is_part_of_the_arm(model: Model) -> None:
    tip = model.rigid_pose(OUT)
    below = tip.position[0] + tip.rotation[0] @ [0, 0, 0.35]
    box = Box(tuple(below - 0.03), tuple(below + 0.03))
    space = Workspace.of(model, keep_out=[box])
    assert space.clear(OUT).all()
    assert not replace(space, loads_end=((0.0, 0.0, 0.55),)).clear(OUT).any()


def test_a_straight_arm_is_nearly_singular(model: Model) -> None:
    space = Workspace.of(model)
    deflected = np.array([[0.3, -1.2, 1.3, -1.0, 1.2, 0.4]])
    assert space.near_singular(space.frames(np.vstack([OUT, deflected]))).tolist() == [True, False]


def test_the_tracker_sees_what_is_before_the_arm_and_not_what_is_behind_it(model: Model) -> None:
    tip = model.rigid_pose(OUT).position[0]
    before = Place((tip[0] - 1.0, tip[1], tip[2]))
    wrist = Workspace.of(model).frames(OUT).origin[0, 4]
    behind = Place(tuple(tip + 3.0 * (wrist - tip)))
    space = Workspace.of(model, places=[before, behind])
    frames = space.frames(OUT)
    assert not space.not_visible(frames, 0, 0)[Rejection(RejectionReason.HIDDEN, 1)].any()
    assert space.not_visible(frames, 1, 0)[Rejection(RejectionReason.HIDDEN, 2)].any()


def test_a_reflector_is_seen_within_its_cone_and_the_instruments_range(model: Model) -> None:
    tip = model.rigid_pose(OUT)
    axis = tip.rotation[0] @ [0, 0, 1.0]
    place = Place(tuple(tip.position[0] + 2.0 * axis), nearest=0.5, farthest=3.0)
    space = Workspace.of(
        model, places=[place], reflector=Reflector(looks=[(0, 0, 1)], acceptance=np.radians(30))
    )
    turned = Rejection(RejectionReason.TURNED, 1)
    assert not space.not_visible(space.frames(OUT), 0, 0)[turned].any()
    away = replace(space, looks=-space.looks)
    assert away.not_visible(away.frames(OUT), 0, 0)[turned].all()
    near = replace(space, places=(replace(place, nearest=2.5),))
    assert near.not_visible(near.frames(OUT), 0, 0)[Rejection(RejectionReason.RANGE, 1)].all()


@pytest.mark.parametrize(
    ("given_to_space", "expected"),
    [
        ({"lower": [0] * 5}, "lower: found 5 values, expected 6"),
        ({"lower": [1] * 6, "upper": [0.5] * 6}, "joint 1: found limits 1 to 0.5"),
        ({"keep_out": [Box((0, 0, 1), (1, 1, 0))]}, "keep-out box 1: .*lower below upper"),
    ],
)
def test_rooms_that_cannot_be_are_declined(model: Model, given_to_space, expected) -> None:
    with pytest.raises(PlanError, match=expected):
        Workspace.of(model, **given_to_space)


coordinate = st.floats(-2, 2, allow_nan=False)
point = st.tuples(coordinate, coordinate, coordinate).map(np.array)


@given(point, point, point, point)
@example(np.zeros(3), np.array([1, 0, 1]), np.array([1, 0, 0]), np.array([1, 0, 6e-8]))
@settings(max_examples=50, deadline=None)
def test_no_two_points_of_two_segments_are_nearer_than_their_distance(p, q, r, s) -> None:
    share = np.linspace(0, 1, 41)[:, None]
    one, other = p + share * (q - p), r + share * (s - r)
    nearest = np.linalg.norm(one[:, None] - other[None], axis=2).min()
    found = float(segment_distance(p, q, r, s))
    longest = max(np.linalg.norm(q - p), np.linalg.norm(s - r))
    # what is parallel to 1e-6 rad counts as parallel, what is shorter than 1e-6 m as a point
    assert found <= nearest + 1e-5
    assert found >= nearest - longest / 40 - 1e-5
