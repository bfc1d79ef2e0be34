"""The plan of a calibration session: the poses and loads most informative for its parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.nuisance import Layout
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Payload, Plan
from gapbridge.core.effects import flexibility_effects
from gapbridge.core.errors import PlanError
from gapbridge.core.loads import Loads
from gapbridge.core.notes import Note, Reason
from gapbridge.core.planning.candidates import STOPS, Candidates, candidates_of, joined
from gapbridge.core.planning.exchange import (
    Choice,
    backward_eliminated,
    exchanged,
    forward_selected,
)
from gapbridge.core.planning.information import (
    Reference,
    blocks,
    expectation_of,
    information_of,
    inverse,
)
from gapbridge.core.planning.refinement import Refined, Refiner, evened, leaning
from gapbridge.core.planning.route import Stop, itinerary
from gapbridge.core.planning.travel import joint_speed, leg_times
from gapbridge.core.planning.workspace import Workspace

REFERENCE = 200  # poses over which the predicted TCP is judged
BOUGHT_ROUNDS = 3
BOUGHT = (0.5, 0.75, 1.0, 1.5, 2.0)  # of the poses asked for: what these would give
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class SessionDesign:
    """What a session to plan is asked to be."""

    poses: int = 30  # to fit
    held_out: int = 8  # to verify
    repeats: int = 3  # visits to a pose a second time
    seed: int = 0
    sigma: float = 3e-5  # m, 1 sigma of one coordinate: instrument and arm together
    travel_weight: float = 0.02  # share of the TCP's std that a usual leg more at every pose costs
    stops: int = STOPS  # candidate poses that are looked at


def plan(
    parameters: Parameters,
    observable: Observable,
    loads: Sequence[Payload],
    workspace: Workspace,
    asked: SessionDesign,
    progress: Progress | None = None,
) -> Plan:
    """Return the most informative poses, loads and approaches, in the order of travel.

    Chosen so that the TCP predicted by the calibrated model is known best over the whole reachable
    workspace and under all ``loads``, the worst places before the others.
    Raises PlanError where no pose is reachable and seen, or where the poses cannot be enough.
    """
    with threadpool_limits(1, "blas"):  # matrices of this size gain nothing from threads
        return _planned(parameters, observable, loads, workspace, asked, progress or _silent)


def _silent(text: str, share: float) -> None:
    """Report to nobody."""


def _planned(
    parameters: Parameters,
    observable: Observable,
    loads: Sequence[Payload],
    workspace: Workspace,
    asked: SessionDesign,
    emit: Progress,
) -> Plan:
    loads = _in_order(parameters, loads)
    _require_numbers(parameters, observable, asked)
    emit("looking for poses", 0.0)
    workspace = replace(workspace, hung=(*workspace.hung, *(far_end(load) for load in loads)))
    found = candidates_of(parameters, observable, loads, workspace, asked.seed, asked.stops)
    _require_enough(parameters, observable, found, asked)
    emit("working out what each pose contributes", 0.1)
    rows = blocks(parameters, observable, found.readings, found.nuisance, asked.sigma)
    reference = reference_of(parameters, loads, workspace, asked.seed)
    cost = _cost(parameters, found, asked)
    choice = Choice.of(rows, reference.weight(rows.shape[2]), cost)
    chosen = _chosen(choice, asked, lambda share: emit("choosing poses", 0.2 + 0.3 * share))
    share = leaning(reference, rows[chosen])
    weight = reference.weight(rows.shape[2], share)
    chosen = exchanged(Choice.of(rows, weight, cost), chosen)
    refiner = Refiner(parameters, observable, workspace, found, weight, asked.sigma)
    best, weight = evened(
        refiner, reference, Refined(found.readings[np.array(chosen)], rows[chosen]), share,
        asked.seed,
        lambda share: emit("moving poses to more informative places", 0.5 + 0.2 * share),
    )  # fmt: skip
    choice, refiner = Choice.of(rows, weight, cost), replace(refiner, weight=weight)
    emit("working out what more or fewer poses buy", 0.7)
    bought = _bought(choice, chosen, asked, refiner, reference)
    bought[asked.poses] = _rms(reference, best.rows)
    emit("finding a short way", 0.95)
    checks = [Stop(row, held_out=True) for row in _held_out(found, chosen, asked)]
    found = joined(found, best.readings)
    fit = [Stop(len(rows) + i) for i in range(asked.poses)]
    way = itinerary(found, fit + checks, workspace, asked.repeats)
    again = [stop.row - len(rows) for stop in way.stops if stop.repeat]
    measured = np.concatenate([best.rows, best.rows[again]])
    expected = expectation_of(parameters, measured, reference)
    emit("planned", 1.0)
    hung = set(found.readings.load[len(rows) :])
    unseen = () if workspace.places or observable.unknown else (Note(Reason.SIGHT_UNKNOWN),)
    notes = (*found.notes, *unseen, *way.notes, *_notes(parameters, loads, hung, expected.std))
    return Plan(
        tuple(loads), way.poses(found), expected, tuple(sorted(bought.items())), way.travel, notes
    )


def _in_order(parameters: Parameters, loads: Sequence[Payload]) -> list[Payload]:
    """Return the loads, the lightest first; raises PlanError for one that the arm cannot carry."""
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


def far_end(load: Payload) -> tuple[float, float, float]:
    """Return how far a load reaches (m, flange axes): as far beyond its middle as before."""
    return (2 * load.cog[0], 2 * load.cog[1], 2 * load.cog[2])


def _require_numbers(parameters: Parameters, observable: Observable, asked: SessionDesign) -> None:
    """Raise PlanError where the poses give no more numbers than there are unknowns.

    Arithmetic, before any pose is looked for: the instrument is counted as standing at one place.
    """
    frame = () if observable.registered and not observable.unknown else observable.frame
    layout = Layout(1, 1, frame, observable.free_length, observable.first_target)
    _require(len(parameters) + layout.size, observable, asked)


def _require(unknown: int, observable: Observable, asked: SessionDesign) -> None:
    needed = unknown // observable.equations + 1
    if asked.poses < needed:
        raise PlanError(
            f"too few poses: found {asked.poses}, expected at least {needed}: {unknown} unknowns, "
            f"{observable.equations} number(s) a {observable.kind} reading; plan more poses or "
            "ask for fewer effects"
        )


def _require_enough(
    parameters: Parameters, observable: Observable, found: Candidates, asked: SessionDesign
) -> None:
    _require(len(parameters) + observable.layout(found.readings).size, observable, asked)
    if len(found.readings) < asked.poses + asked.held_out:
        raise PlanError(
            f"poses: {len(found.readings)} can be reached and seen, expected at least "
            f"{asked.poses + asked.held_out}; {found.hindered}"
        )


def reference_of(
    parameters: Parameters, loads: Sequence[Payload], workspace: Workspace, seed: int
) -> Reference:
    """Return poses anywhere in the cell, seen by the instrument or not, under the loads in turn."""
    random = np.random.default_rng(seed + 1)
    drawn = workspace.draw(20 * REFERENCE, random)
    clear = drawn[workspace.clear(drawn)]
    q = clear[:REFERENCE] if len(clear) else drawn[:REFERENCE]
    turn = np.arange(len(q)) % len(loads)
    approach = random.choice([-1.0, 1.0], q.shape) if parameters.sided() else None
    mass, cog = np.array([load.mass for load in loads]), np.array([load.cog for load in loads])
    return Reference.of(parameters, q, Loads(mass[turn], cog[turn], approach=approach))


def _cost(
    parameters: Parameters, found: Candidates, asked: SessionDesign
) -> Callable[[Sequence[int]], Array]:
    """Return what adding each candidate costs in travel: its legs to the two nearest stops."""
    speed = joint_speed(parameters.nominal.arm.limits.velocity)
    legs = leg_times(found.q, found.q, speed)
    usual = float(np.median(legs)) or 1.0
    load, stop = found.readings.load, found.stop
    unit = asked.travel_weight / (2 * usual * asked.poses)

    def cost(chosen: Sequence[int]) -> Array:
        extra = np.full(len(load), 2 * usual)
        for number in range(int(load.max()) + 1):
            own = [row for row in chosen if load[row] == number]
            if len(own) > 1:
                here = load == number
                near = np.partition(legs[np.ix_(stop[own], stop[here])], 1, axis=0)
                extra[here] = near[0] + near[1]
        return unit * extra

    return cost


def _rms(reference: Reference, rows: Array) -> float:
    """Return the expected rms error of the TCP (m) over the reference, each pose alike."""
    return float(np.sqrt(np.mean(reference.std(inverse(information_of(rows))) ** 2)))


def _chosen(choice: Choice, asked: SessionDesign, report: Callable[[float], None]) -> list[int]:
    size, k = choice.rows.shape[2], choice.rows.shape[1]
    return exchanged(
        choice, forward_selected(choice, [], asked.poses, -(-size // k)), report=report
    )


def _bought(
    choice: Choice, chosen: list[int], asked: SessionDesign, refiner: Refiner, reference: Reference
) -> dict[int, float]:
    """Return what fewer and more poses would give, each number's poses chosen anew."""
    size, k = choice.rows.shape[2], choice.rows.shape[1]
    fewest = -(-size // k)
    std_of: dict[int, float] = {}
    for count in sorted({max(round(share * asked.poses), fewest) for share in BOUGHT}):
        if count == len(chosen):
            continue
        fewer = count < len(chosen)
        some = (
            backward_eliminated(choice, chosen, count)
            if fewer
            else forward_selected(choice, chosen, count, 0)
        )
        some = exchanged(choice, some, rounds=1)
        readings = refiner.found.readings[np.array(some)]
        random = np.random.default_rng(asked.seed)
        best = refiner.refined(Refined(readings, choice.rows[some]), BOUGHT_ROUNDS, random)
        std_of[len(some)] = _rms(reference, best.rows)
    return std_of


def _held_out(found: Candidates, chosen: list[int], asked: SessionDesign) -> list[int]:
    """Return candidates at poses that are not fitted, drawn at random, the fitted loads in turn."""
    random = np.random.default_rng(asked.seed + 2)
    used = set(found.stop[chosen])
    loads = np.unique(found.readings.load[chosen])
    picked: list[int] = []
    for row in random.permutation(len(found.readings)):
        wanted = loads[len(picked) % len(loads)]
        if len(picked) == asked.held_out:
            break
        if found.stop[row] not in used and found.readings.load[row] == wanted:
            picked.append(int(row))
            used.add(found.stop[row])
    return picked


def _notes(
    parameters: Parameters, loads: Sequence[Payload], hung: set[int], std: Array
) -> list[Note]:
    notes = []
    vague = tuple(n for n, s in zip(parameters.names, std, strict=True) if not np.isfinite(s))
    if vague:
        notes.append(Note(Reason.NOT_IDENTIFIABLE, (vague,)))
    idle = tuple(load.mass for i, load in enumerate(loads) if i not in hung)
    if idle:
        notes.append(Note(Reason.IDLE_LOADS, (idle,)))
    soft = [e for e in flexibility_effects().values() if parameters.joints(e)]
    if soft and len(loads) == 1:
        notes.append(Note(Reason.ONE_LOAD))
    return notes
