"""Plans: what they hold, that they beat chance, and when they are declined."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from planned_cell import (
    LOADS,
    POSITION,
    SIGMA,
    small_model,
    small_parameters,
    small_space,
)

from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Payload, Plan
from gapbridge.core.errors import PlanError
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason
from gapbridge.core.planning import design
from gapbridge.core.planning.candidates import sample_candidates
from gapbridge.core.planning.design import Visit, draw_reference, plan_route
from gapbridge.core.planning.exchange import (
    Choice,
    backward_eliminated,
    exchanged,
    forward_selected,
)
from gapbridge.core.planning.information import information_of, inverse, whitened_rows
from gapbridge.core.workspace.workspace import Place, Reflector, Workspace


def plan(*given, progress=lambda text, share: None, **asked) -> Plan:
    """Plan from few candidates: a test need not find the very best."""
    return design.plan(*given, design.SessionDesign(**{"stops": 150} | asked), progress)


@pytest.fixture(scope="module")
def model() -> Model:
    return small_model()


@pytest.fixture(scope="module")
def space(model: Model) -> Workspace:
    return small_space(model, reflector=Reflector(looks=[(0, 0, 1)], acceptance=np.radians(60)))


@pytest.fixture(scope="module")
def parameters(model: Model) -> Parameters:
    return small_parameters(model)


@pytest.fixture(scope="module")
def planned(parameters: Parameters, space: Workspace) -> Plan:
    return plan(
        parameters, POSITION, LOADS, space, poses=12, held_out=4, repeats=3, sigma=SIGMA, seed=3
    )


def test_a_plan_holds_what_was_asked_for(planned: Plan) -> None:
    assert [load.mass for load in planned.loads] == [0.0, 4.0]  # the lightest first
    fitted = [p for p in planned.poses if not p.held_out and not p.repeat]
    assert len(fitted) == 12
    assert sum(p.held_out for p in planned.poses) == 4
    again = [p for p in planned.poses if p.repeat]
    assert len(again) == 3
    for pose in again:
        first = next(p for p in planned.poses if p.number == pose.number)
        assert (first.q == pose.q).all() and first.load == pose.load and not first.repeat


def test_loads_are_hung_once_and_each_block_ends_where_it_began(planned: Plan) -> None:
    order = [p.load for p in planned.poses]
    assert order == sorted(order)
    for load in (0, 1):
        block = [p for p in planned.poses if p.load == load]
        first = next(p.number for p in block if not p.held_out)
        assert first in [p.number for p in block if p.repeat]


def test_held_out_poses_are_poses_of_their_own(planned: Plan) -> None:
    fitted = {p.q.tobytes() for p in planned.poses if not p.held_out}
    assert not fitted & {p.q.tobytes() for p in planned.poses if p.held_out}


def test_as_many_poses_are_held_out_as_the_fit_leaves(
    parameters: Parameters, space: Workspace
) -> None:
    asked = {"poses": 8, "repeats": 0, "seed": 1}
    planned = plan(parameters, POSITION, LOADS, space, held_out=4, stops=12, **asked)
    assert sum(p.held_out for p in planned.poses) == 4
    assert not [note for note in planned.notes if note.reason is Reason.FEW_HELD_OUT]
    planned = plan(parameters, POSITION, LOADS, space, held_out=7, stops=12, **asked)
    left = sum(p.held_out for p in planned.poses)
    assert left == 12 - len({p.q.tobytes() for p in planned.poses if not p.held_out})
    assert left < 7 and Note(Reason.FEW_HELD_OUT, (left, 7)) in planned.notes
    with pytest.raises(
        PlanError, match="poses: 12 are reachable and visible, expected at least 13"
    ):
        plan(parameters, POSITION, LOADS, space, held_out=9, stops=12, **asked)


def test_a_detour_to_the_first_pose_with_the_next_load_is_noted(
    parameters: Parameters, space: Workspace
) -> None:
    found = sample_candidates(parameters, POSITION, LOADS, space, 1, 30)
    shares = np.linspace(0, 1, 11)[1:-1, None]
    there = next(
        there
        for there in range(1, 30)
        if not space.clear(found.q[0] + shares * (found.q[there] - found.q[0])).all()
    )
    stops = [Visit(0), Visit(30 + there)]  # the second under the other load
    assert plan_route(found, stops, space, 0).notes == (Note(Reason.DETOURS, (((1, 2),),)),)


def test_every_planned_pose_can_be_reached_and_seen(planned: Plan, space: Workspace) -> None:
    q = np.array([p.q for p in planned.poses])
    assert space.clear(q).all()
    for missed in space.not_visible(space.frames(q), 0, 0).values():
        assert not missed.any()


def test_the_same_seed_plans_the_same(
    planned: Plan, parameters: Parameters, space: Workspace
) -> None:
    again = plan(
        parameters, POSITION, LOADS, space, poses=12, held_out=4, repeats=3, sigma=SIGMA, seed=3
    )
    assert all((a.q == b.q).all() for a, b in zip(planned.poses, again.poses, strict=True))


def test_more_poses_buy_less_uncertainty(planned: Plan) -> None:
    counts, std = zip(*planned.bought, strict=True)
    assert 12 in counts and len(counts) >= 4
    assert list(counts) == sorted(counts)
    assert list(std) == sorted(std, reverse=True)
    # the second visits determine a little too
    assert planned.expected.tcp_std < dict(planned.bought)[12]


def test_planned_poses_beat_more_random_ones(
    planned: Plan, parameters: Parameters, space: Workspace
) -> None:
    found = sample_candidates(parameters, POSITION, LOADS, space, 11, 400)
    rows = whitened_rows(parameters, POSITION, found.readings, found.nuisance, SIGMA)
    reference = draw_reference(parameters, planned.loads, space, 3)
    random = np.random.default_rng(0)

    def chance(count: int) -> list[np.ndarray]:
        drawn = [rows[random.choice(len(rows), count, replace=False)] for _ in range(30)]
        return [reference.std(inverse(information_of(some))) for some in drawn]

    half_more, twice = chance(18), chance(24)
    rms = np.median([np.sqrt(np.mean(std**2)) for std in half_more])
    assert dict(planned.bought)[12] < rms
    assert planned.expected.tcp_std_worst < np.median([std.max() for std in twice])


@pytest.mark.slow
def test_travel_counts(parameters: Parameters, space: Workspace) -> None:
    far, near = (
        plan(parameters, POSITION, LOADS, space, poses=12, held_out=0, repeats=0, travel_weight=w)
        for w in (0.0, 3.0)
    )
    assert near.travel < far.travel


def test_joints_with_play_are_approached_from_both_sides(model: Model, space: Workspace) -> None:
    loose = identifiable_parameters(
        model, ("tool_frame", "backlash_2", "backlash_3"), observable=POSITION
    )
    planned = plan(loose, POSITION, LOADS, space, poses=8, held_out=2, repeats=1)
    sides = np.array([p.approach for p in planned.poses])
    assert set(np.unique(sides[:, 1:3])) == {-1.0, 1.0}
    assert not sides[:, [0, 3, 4, 5]].any()
    assert np.isfinite(planned.expected.std).all()


@pytest.mark.parametrize("kind", ["sphere", "point"])
def test_closures_are_planned_where_the_tip_touches(model: Model, kind: str) -> None:
    observable = make_observable(kind)
    centre = np.array([0.45, 0.2, 0.35])
    space = small_space(model, places=[Place(tuple(centre))])
    parameters = identifiable_parameters(
        model, ("tool_frame", "joint_offset"), observable=observable
    )
    planned = plan(parameters, observable, [Payload(0.0)], space, poses=15, held_out=2, repeats=1)
    tip = model.predict(np.array([p.q for p in planned.poses])).position
    wanted = 0.03 if kind == "sphere" else 0.0
    assert np.linalg.norm(tip - centre, axis=1) == pytest.approx(wanted, abs=1e-6)


def test_a_gauge_keeps_within_its_range(model: Model) -> None:
    observable = make_observable("distance")
    space = small_space(model, places=[Place((0.4, 0.2, 0.3), 0.15, 0.4)])
    parameters = identifiable_parameters(
        model, ("tool_frame", "joint_offset"), observable=observable
    )
    planned = plan(parameters, observable, [Payload(0.0)], space, poses=20, held_out=0, repeats=0)
    tip = model.predict(np.array([p.q for p in planned.poses])).position
    long = np.linalg.norm(tip - [0.4, 0.2, 0.3], axis=1)
    assert long.min() >= 0.15 and long.max() <= 0.4


def test_progress_is_reported_from_nothing_to_all(parameters: Parameters, space: Workspace) -> None:
    reported: list[float] = []
    plan(
        parameters, POSITION, LOADS, space, poses=8, held_out=0, repeats=0,
        progress=lambda text, share: reported.append(share),
    )  # fmt: skip
    assert reported[0] == 0.0 and reported[-1] == 1.0
    assert reported == sorted(reported)


def test_one_load_alone_and_an_unknown_place_are_reported(
    parameters: Parameters, space: Workspace
) -> None:
    space = replace(space, places=())
    planned = plan(parameters, POSITION, LOADS[:1], space, poses=8, held_out=0, repeats=0)
    assert Note(Reason.SIGHT_UNKNOWN) in planned.notes
    assert Note(Reason.ONE_LOAD) in planned.notes


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"loads": ()}, "loads: found none"),
        ({"loads": [Payload(40.0, name="anvil")]}, "load 1 anvil: found 40 kg, .*rated 5 kg"),
        ({"poses": 3}, "poses: found 3, expected at least"),
    ],
)
def test_wishes_that_cannot_be_met_are_declined_in_one_line(
    parameters: Parameters, space: Workspace, changed, expected
) -> None:
    loads = changed.pop("loads", LOADS)
    with pytest.raises(PlanError, match=expected) as caught:
        plan(parameters, POSITION, loads, space, **changed)
    assert "\n" not in str(caught.value)


def test_where_nothing_is_seen_the_reason_is_reported(
    parameters: Parameters, space: Workspace
) -> None:
    blind = replace(space, places=(Place((9.0, 0.0, 0.5), farthest=1.0),))
    with pytest.raises(PlanError, match=r"no pose is reachable and visible: .* out of range"):
        plan(parameters, POSITION, LOADS, blind)


def test_a_fixed_point_without_a_place_is_asked_for(model: Model) -> None:
    observable = make_observable("sphere")
    parameters = identifiable_parameters(model, ("tool_frame",), observable=observable)
    with pytest.raises(PlanError, match="places: found none, expected where in base"):
        plan(parameters, observable, LOADS, Workspace.of(model))


def test_exchange_finds_the_ends_of_a_straight_line() -> None:
    # y = a + b x on [-1, 1]: the best four readings sit two and two at the ends
    x = np.linspace(-1, 1, 21).repeat(2)
    rows = 100 * np.stack([np.ones(42), x], axis=1)[:, None]
    choice = Choice.of(rows, np.diag([1.0, 1 / 3]), lambda chosen: np.zeros(42))
    chosen = exchanged(choice, forward_selected(choice, [], 4, 2))
    assert sorted(x[chosen]) == [-1, -1, 1, 1]
    assert len(backward_eliminated(choice, chosen, 3)) == 3


def test_gains_are_what_adding_a_candidate_brings() -> None:
    random = np.random.default_rng(0)
    rows = random.normal(size=(30, 3, 8))
    root = random.normal(size=(8, 8))
    choice = Choice.of(rows, root @ root.T, lambda chosen: np.zeros(30))
    gains = choice.gains([0, 1, 2, 3])
    for row in (4, 17, 29):
        assert np.exp(gains[row]) == pytest.approx(choice.value([0, 1, 2, 3, row]))
    assert np.isinf(gains[:4]).all()


@pytest.mark.slow
def test_two_places_and_two_balls_are_visited_one_place_after_the_other(
    parameters: Parameters, model: Model
) -> None:
    places = [Place((2.0, 0.5, 0.6), 0.3), Place((-1.5, 1.5, 0.8), 0.3)]
    space = small_space(model, places=places, reflector=Reflector([(0, 0, 0), (0.1, 0.05, 0)]))
    planned = plan(parameters, POSITION, LOADS, space, poses=16, held_out=2, repeats=2)
    stations = [pose.station for pose in planned.poses]
    assert stations == sorted(stations) and set(stations) == {0, 1}
    assert {pose.target for pose in planned.poses} == {0, 1}
    turns = sum(a.load != b.load for a, b in pairwise(planned.poses))
    assert turns <= 3  # a load is not hung anew for the second place


def test_a_load_that_shows_nothing_is_named(parameters: Parameters, space: Workspace) -> None:
    loads = [Payload(0.0), Payload(0.01), Payload(4.0, (0.0, 0.02, 0.06))]
    planned = plan(parameters, POSITION, loads, space, poses=9, held_out=3, repeats=0)
    hung = {planned.loads[pose.load].mass for pose in planned.poses}
    idle = [note for note in planned.notes if note.reason is Reason.IDLE_LOADS]
    assert any(0.01 in note.values[0] for note in idle) == (0.01 not in hung)
    assert 4.0 in hung


def test_too_few_poses_are_said_before_any_is_looked_for(
    parameters: Parameters, space: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gapbridge.core.planning.design.sample_candidates", None)
    with pytest.raises(PlanError, match=r"calibration\.poses: found 3, expected at least"):
        plan(parameters, POSITION, LOADS, space, poses=3)
