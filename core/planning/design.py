"""The plan of a calibration session: the poses and loads most informative for its parameters.

Their visits are grouped by place and load, with short moves within each group.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from threadpoolctl import threadpool_limits

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.calibration.observables.nuisance import Layout
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Payload, Plan, PlannedPose
from gapbridge.core.effects import flexibility_effects
from gapbridge.core.errors import PlanError
from gapbridge.core.loads import Loads
from gapbridge.core.notes import Note, Reason
from gapbridge.core.planning.candidates import STOPS, Candidates, sample_candidates, with_readings
from gapbridge.core.planning.exchange import (
    Choice,
    backward_eliminated,
    exchanged,
    forward_selected,
)
from gapbridge.core.planning.information import (
    Reference,
    expected_accuracy,
    information_of,
    inverse,
    whitened_rows,
)
from gapbridge.core.planning.refinement import (
    RefinedPoses,
    Refiner,
    minimax_refined,
    reference_weights,
)
from gapbridge.core.planning.travel import joint_speed, move_times, shortest_order
from gapbridge.core.workspace.workspace import Workspace

REFERENCE_POSES = 200  # poses over which the accuracy of the predicted TCP is evaluated
COMPARISON_ROUNDS = 3
POSE_COUNT_FACTORS = (0.5, 0.75, 1.0, 1.5, 2.0)  # of the requested poses, for the comparison
Progress = Callable[[str, float], None]
CHECKS_PER_LEG = 9  # intermediate poses checked for collision on a leg
COLLISION_FACTOR = 3.0  # factor on the cost of a leg with a collision


@dataclass(frozen=True)
class SessionDesign:
    """The requested size and noise of a session."""

    poses: int = 30  # to fit
    held_out: int = 8  # to verify
    repeats: int = 3  # visits to a pose a second time
    seed: int = 0
    sigma: float = 3e-5  # m, 1 sigma of one coordinate: instrument and arm together
    travel_weight: float = 0.02  # share of the TCP's std that one median leg per pose is worth
    stops: int = STOPS  # candidate poses


def plan(
    parameters: Parameters,
    observable: Observable,
    loads: Sequence[Payload],
    workspace: Workspace,
    design: SessionDesign,
    progress: Progress = lambda text, share: None,
) -> Plan:
    """Return the most informative poses, loads and approaches, in the order of travel.

    Chosen to minimise the worst-case uncertainty of the TCP predicted by the calibrated model, over
    the reachable workspace and all ``loads``. Raises PlanError where no pose is reachable and
    visible, or where the poses are too few for the parameters.
    """
    with threadpool_limits(1, "blas"):  # matrices of this size gain nothing from threads
        return _planned(parameters, observable, loads, workspace, design, progress)


def _planned(
    parameters: Parameters,
    observable: Observable,
    loads: Sequence[Payload],
    workspace: Workspace,
    design: SessionDesign,
    emit: Progress,
) -> Plan:
    loads = _checked_loads(parameters, loads)
    _require_numbers(parameters, observable, design)
    emit("looking for poses", 0.0)
    ends = (load_extent(load) for load in loads)
    workspace = replace(workspace, loads_end=(*workspace.loads_end, *ends))
    candidates = sample_candidates(
        parameters, observable, loads, workspace, design.seed, design.stops
    )
    _require_enough(parameters, observable, candidates, design)
    emit("evaluating candidate poses", 0.1)
    rows = whitened_rows(
        parameters, observable, candidates.readings, candidates.nuisance, design.sigma
    )
    reference = draw_reference(parameters, loads, workspace, design.seed)
    cost = _travel_cost(parameters, candidates, design)
    choice = Choice.of(rows, reference.weight(rows.shape[2]), cost)
    chosen = _selected(choice, design, lambda share: emit("choosing poses", 0.2 + 0.3 * share))
    share = reference_weights(reference, rows[chosen])
    weight = reference.weight(rows.shape[2], share)
    chosen = exchanged(Choice.of(rows, weight, cost), chosen)
    refiner = Refiner(parameters, observable, workspace, candidates, weight, design.sigma)
    refined, weight = minimax_refined(
        refiner, reference, RefinedPoses(candidates.readings[np.array(chosen)], rows[chosen]),
        share, design.seed,
        lambda share: emit("refining poses", 0.5 + 0.2 * share),
    )  # fmt: skip
    choice, refiner = Choice.of(rows, weight, cost), replace(refiner, weight=weight)
    emit("comparing numbers of poses", 0.7)
    std_of = _std_by_poses(choice, chosen, design, refiner, reference)
    std_of[design.poses] = _expected_rms(reference, refined.rows)
    emit("planning the route", 0.95)
    checks = [Visit(row, held_out=True) for row in _held_out(candidates, chosen, design)]
    candidates = with_readings(candidates, refined.readings)
    fit = [Visit(len(rows) + i) for i in range(design.poses)]
    route = plan_route(candidates, fit + checks, workspace, design.repeats)
    repeated = [stop.row - len(rows) for stop in route.stops if stop.repeat]
    measured = np.concatenate([refined.rows, refined.rows[repeated]])
    expected = expected_accuracy(parameters, measured, reference)
    emit("planned", 1.0)
    used_loads = set(candidates.readings.load[len(rows) :])
    sight = () if workspace.places or observable.unknown else (Note(Reason.SIGHT_UNKNOWN),)
    warnings = _notes(parameters, loads, used_loads, expected.std)
    held_out = (len(checks), design.held_out)
    few = (Note(Reason.FEW_HELD_OUT, held_out),) if len(checks) < design.held_out else ()
    notes = (*candidates.notes, *few, *sight, *route.notes, *warnings)
    accuracy = tuple(sorted(std_of.items()))
    return Plan(tuple(loads), route.poses(candidates), expected, accuracy, route.travel, notes)


def _checked_loads(parameters: Parameters, loads: Sequence[Payload]) -> list[Payload]:
    """Return the loads by mass; raises PlanError for one beyond the arm's rated payload."""
    if not loads:
        raise PlanError("loads: found none, expected at least one (0 kg is one)")
    rated = parameters.nominal.arm.payload
    for number, load in enumerate(loads):
        if not 0 <= load.mass <= rated:
            raise PlanError(
                f"load {number + 1}{' ' + load.name if load.name else ''}: found {load.mass:g} kg, "
                f"expected 0 to the rated {rated:g} kg"
            )
    return sorted(loads, key=lambda load: load.mass)


def load_extent(load: Payload) -> tuple[float, float, float]:
    """Return the far end of a load (m, flange axes), taken as symmetric about its cog."""
    return (2 * load.cog[0], 2 * load.cog[1], 2 * load.cog[2])


def _require_numbers(parameters: Parameters, observable: Observable, design: SessionDesign) -> None:
    """Raise PlanError where the poses give fewer equations than there are unknowns.

    A lower bound before sampling: with a single place of the instrument.
    """
    frame = () if observable.registered and not observable.unknown else observable.frame
    layout = Layout(1, 1, frame, observable.free_length, observable.first_target)
    _require(len(parameters) + layout.size, observable, design)


def _require(unknown: int, observable: Observable, design: SessionDesign) -> None:
    needed = unknown // observable.equations + 1
    if design.poses < needed:
        raise PlanError(
            f"found {design.poses}, expected at least {needed}: {unknown} unknowns, "
            f"{observable.equations} number(s) a {observable.kind} reading; plan more poses or "
            "ask for fewer effects",
            ("calibration", "poses"),
        )


def _require_enough(
    parameters: Parameters, observable: Observable, candidates: Candidates, design: SessionDesign
) -> None:
    _require(len(parameters) + observable.layout(candidates.readings).size, observable, design)
    found = len(candidates.q)
    each = len(candidates.readings) // found  # loads and approaches
    needed = -(-design.poses // each) + design.held_out  # no held-out pose is fitted
    if found < needed:
        raise PlanError(
            f"poses: {found} are reachable and visible, expected at least {needed}; "
            f"{candidates.rejected}"
        )


def draw_reference(
    parameters: Parameters, loads: Sequence[Payload], workspace: Workspace, seed: int
) -> Reference:
    """Return random poses of the workspace, visible or not, under the loads in turn."""
    random = np.random.default_rng(seed + 1)
    drawn = workspace.draw(20 * REFERENCE_POSES, random)
    clear = drawn[workspace.clear(drawn)]
    q = clear[:REFERENCE_POSES] if len(clear) else drawn[:REFERENCE_POSES]
    turn = np.arange(len(q)) % len(loads)
    approach = random.choice([-1.0, 1.0], q.shape) if parameters.approach_joints() else None
    mass, cog = np.array([load.mass for load in loads]), np.array([load.cog for load in loads])
    return Reference.of(parameters, q, Loads(mass[turn], cog[turn], approach=approach))


def _travel_cost(
    parameters: Parameters, candidates: Candidates, design: SessionDesign
) -> Callable[[Sequence[int]], Array]:
    """Return the travel cost of adding each candidate: its legs to the two nearest stops."""
    speed = joint_speed(parameters.nominal.arm.limits.velocity)
    legs = move_times(candidates.q, candidates.q, speed)
    typical = float(np.median(legs)) or 1.0
    load, stop = candidates.readings.load, candidates.stop
    unit = design.travel_weight / (2 * typical * design.poses)

    def cost(chosen: Sequence[int]) -> Array:
        extra = np.full(len(load), 2 * typical)
        for number in range(int(load.max()) + 1):
            chosen_rows = [row for row in chosen if load[row] == number]
            if len(chosen_rows) > 1:
                same_load = load == number
                nearest = np.partition(legs[np.ix_(stop[chosen_rows], stop[same_load])], 1, axis=0)
                extra[same_load] = nearest[0] + nearest[1]
        return unit * extra

    return cost


def _expected_rms(reference: Reference, rows: Array) -> float:
    """Return the expected rms error of the TCP (m) over the reference poses, unweighted."""
    return float(np.sqrt(np.mean(reference.std(inverse(information_of(rows))) ** 2)))


def _selected(choice: Choice, design: SessionDesign, report: Callable[[float], None]) -> list[int]:
    size, k = choice.rows.shape[2], choice.rows.shape[1]
    return exchanged(
        choice, forward_selected(choice, [], design.poses, -(-size // k)), report=report
    )


def _std_by_poses(
    choice: Choice, chosen: list[int], design: SessionDesign, refiner: Refiner, reference: Reference
) -> dict[int, float]:
    """Return the expected rms error of the TCP (m) by number of poses, each optimised."""
    size, k = choice.rows.shape[2], choice.rows.shape[1]
    least = -(-size // k)
    std_of: dict[int, float] = {}
    for count in sorted({max(round(share * design.poses), least) for share in POSE_COUNT_FACTORS}):
        if count == len(chosen):
            continue
        fewer = count < len(chosen)
        selected = (
            backward_eliminated(choice, chosen, count)
            if fewer
            else forward_selected(choice, chosen, count, 0)
        )
        selected = exchanged(choice, selected, rounds=1)
        readings = refiner.candidates.readings[np.array(selected)]
        random = np.random.default_rng(design.seed)
        refined = refiner.refined(
            RefinedPoses(readings, choice.rows[selected]), COMPARISON_ROUNDS, random
        )
        std_of[len(selected)] = _expected_rms(reference, refined.rows)
    return std_of


def _held_out(candidates: Candidates, chosen: list[int], design: SessionDesign) -> list[int]:
    """Return random candidates at poses that are not fitted, the fitted loads in turn."""
    random = np.random.default_rng(design.seed + 2)
    used = set(candidates.stop[chosen])
    loads = np.unique(candidates.readings.load[chosen])
    picked: list[int] = []
    # a row that is passed over for its load may be wanted next
    for row in np.tile(random.permutation(len(candidates.readings)), design.held_out):
        wanted = loads[len(picked) % len(loads)]
        if len(picked) == design.held_out:
            break
        if candidates.stop[row] not in used and candidates.readings.load[row] == wanted:
            picked.append(int(row))
            used.add(candidates.stop[row])
    return picked


def _notes(
    parameters: Parameters, loads: Sequence[Payload], used_loads: set[int], std: Array
) -> list[Note]:
    notes = []
    vague = tuple(n for n, s in zip(parameters.names, std, strict=True) if not np.isfinite(s))
    if vague:
        notes.append(Note(Reason.NOT_IDENTIFIABLE, (vague,)))
    idle = tuple(load.mass for i, load in enumerate(loads) if i not in used_loads)
    if idle:
        notes.append(Note(Reason.IDLE_LOADS, (idle,)))
    flexible = [e for e in flexibility_effects().values() if parameters.joints(e)]
    if flexible and len(loads) == 1:
        notes.append(Note(Reason.ONE_LOAD))
    return notes


@dataclass(frozen=True)
class Visit:
    """One visit: a candidate's row, and its purpose."""

    row: int
    held_out: bool = False
    repeat: int = 0


@dataclass(frozen=True)
class Route:
    """The stops in the order of travel."""

    stops: tuple[Visit, ...]
    travel: float  # s
    notes: tuple[Note, ...]

    def poses(self, candidates: Candidates) -> tuple[PlannedPose, ...]:
        """Return the planned poses; those at the same joints share a number."""
        numbers: dict[tuple[int, int, bytes], int] = {}
        poses = []
        readings = candidates.readings
        approach = readings.loads.approach
        for stop in self.stops:
            row = stop.row
            side = np.zeros(candidates.q.shape[1]) if approach is None else approach[row]
            key = (int(readings.load[row]), int(candidates.stop[row]), side.tobytes())
            number = numbers.setdefault(key, len(numbers))
            poses.append(PlannedPose(
                number, readings.q[row].copy(), int(readings.load[row]), side.copy(),
                int(readings.station[row]), int(readings.target[row]), stop.held_out, stop.repeat,
            ))  # fmt: skip
        return tuple(poses)


def plan_route(
    candidates: Candidates, stops: Sequence[Visit], workspace: Workspace, repeats: int
) -> Route:
    """Return the route through all stops and ``repeats`` second visits.

    The first pose of a load is repeated at its end, to detect an instrument that has moved.
    """
    readings = candidates.readings
    speed = joint_speed(workspace.model.arm.limits.velocity)
    blocks = _blocks(candidates, stops)
    counts = _repeats_per_block(
        [sum(not stop.held_out for stop in block) for block in blocks], repeats
    )
    previous: Array | None = None
    travel = 0.0
    ordered: list[Visit] = []
    detours: list[tuple[int, int]] = []  # stops from 1
    for block, repeated in zip(blocks, counts, strict=True):
        count, q = len(block), readings.q[[stop.row for stop in block]]
        # the last stop before the block is the last row
        known = q if previous is None else np.vstack([q, previous])
        legs, blocked = _legs_between(known, workspace, speed)
        cost = np.where(blocked, COLLISION_FACTOR * legs + 1.0, legs)
        first = np.zeros(count) if previous is None else cost[count, :count]
        order = shortest_order(cost[:count, :count], first)
        visits = [block[i] for i in order]
        fitted = [i for i in order if not block[i].held_out]
        order += [fitted[i] for i in _repeat_indices(len(fitted), repeated)]
        begin = [] if previous is None else [count]
        for stop, (a, b) in enumerate(pairwise(begin + order), len(ordered) + 1 - len(begin)):
            travel += float(legs[a, b])
            if blocked[a, b]:
                detours.append((stop, stop + 1))
        ordered += visits + [replace(block[i], repeat=1) for i in order[count:]]
        previous = q[order[-1]]
    notes = (Note(Reason.DETOURS, (tuple(detours),)),) if detours else ()
    return Route(tuple(ordered), travel, notes)


def _repeats_per_block(fitted: list[int], repeats: int) -> list[int]:
    """Return how many fitted stops of each block are repeated, distributed evenly."""
    counts = [0] * len(fitted)
    for _ in range(min(repeats, sum(fitted))):
        block = min(
            (b for b in range(len(counts)) if counts[b] < fitted[b]), key=lambda b: counts[b]
        )
        counts[block] += 1
    return counts


def _repeat_indices(count: int, repeated: int) -> list[int]:
    """Return which stops of a block are repeated: the first, then evenly spaced ones."""
    step = count / max(repeated, 1)
    return [int(i * step) for i in range(min(repeated, count))]


def _blocks(candidates: Candidates, stops: Sequence[Visit]) -> list[list[Visit]]:
    """Return the stops by place, then load; the order of loads alternates between places."""
    readings = candidates.readings
    groups: dict[tuple[int, int], list[Visit]] = {}
    for stop in stops:
        key = (int(readings.station[stop.row]), int(readings.load[stop.row]))
        groups.setdefault(key, []).append(stop)

    def block_order(key: tuple[int, int]) -> tuple[int, int]:
        station, load = key
        return station, load if station % 2 == 0 else -load

    return [groups[key] for key in sorted(groups, key=block_order)]


def _legs_between(q: Array, workspace: Workspace, speed: Array) -> tuple[Array, Mask]:
    """Return the times (B, B), s, between poses, and which straight joint moves collide."""
    count = len(q)
    legs = move_times(q, q, speed)
    blocked = np.zeros((count, count), dtype=bool)
    one, other = np.triu_indices(count, 1)
    if len(one):
        share = np.linspace(0, 1, CHECKS_PER_LEG + 2)[1:-1]
        between = q[one][:, None] + share[:, None] * (q[other] - q[one])[:, None]
        clear = workspace.clear(between.reshape(-1, q.shape[1])).reshape(-1, CHECKS_PER_LEG)
        blocked[one, other] = blocked[other, one] = ~clear.all(axis=1)
    return legs, blocked
