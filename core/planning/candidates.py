"""Candidate readings of a plan: reachable poses that the instrument sees, under every load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gapbridge.core.arrays import Array, Index, Mask
from gapbridge.core.calibration.observables.fixed_point import fixed_at
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.observables.predicted_readings import (
    beside,
    empty_readings,
    predicted_readings,
)
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Payload
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.errors import PlanError
from gapbridge.core.loads import Loads
from gapbridge.core.notes import Note, Reason
from gapbridge.core.planning.workspace import Place, Space

STOPS = 900  # candidate poses
DRAWN = 4000  # random poses looked at in one go
TRIES = 40
HOPELESS = 6  # tries without any pose after which none is expected
BALLS_APART = 0.2  # m, of two balls on the tool where nobody says it


@dataclass(frozen=True)
class Candidates:
    """C poses, each under every load and, where joints have play, with opposite approaches."""

    q: Array  # (C, n) rad
    readings: Readings  # (R,) exact readings that the model foresees
    stop: Index  # (R,) number of the pose
    nuisance: Nuisance
    why: str  # what hinders random poses, in words
    notes: tuple[Note, ...]


@dataclass
class _Sight:
    """Poses found so far, and what hindered the others."""

    q: list[Array]
    station: list[Index]
    target: list[Index]
    looked: int
    hindered: dict[str, int]

    @property
    def count(self) -> int:
        return sum(len(q) for q in self.q)

    @property
    def why(self) -> str:
        worst = sorted(self.hindered.items(), key=lambda item: -item[1])[:3]
        parts = [f"{100 * n / max(self.looked, 1):.0f} % {reason}" for reason, n in worst if n]
        return f"of {self.looked} random poses " + (", ".join(parts) or "none can be read")


def candidates_of(
    parameters: Parameters,
    observable: Observable,
    loads: Sequence[Payload],
    space: Space,
    seed: int,
    stops: int = STOPS,
) -> Candidates:
    """Return candidates at up to ``stops`` poses.

    Raises PlanError where no pose is reachable and seen.
    """
    if observable.unknown and not space.places:
        raise PlanError(
            f"places: found none, expected where in base the fixed point of the {observable.kind} "
            "readings is"
        )
    nuisance = _nuisance(observable, space)
    random = np.random.default_rng(seed)
    sight = _Sight([], [], [], 0, {})
    for tried in range(TRIES):
        _look(parameters, observable, space, nuisance, random, sight)
        if sight.count >= stops or (tried >= HOPELESS and not sight.count):
            break
    if not sight.count:
        raise PlanError(f"no pose can be reached and seen: {sight.why}")
    q, station = np.concatenate(sight.q)[:stops], np.concatenate(sight.station)[:stops]
    target = np.concatenate(sight.target)[:stops]
    readings, stop = _under_loads(parameters, observable, loads, (q, station, target), random)
    notes = () if sight.count >= stops else (Note(Reason.FEW_POSES, (sight.why,)),)
    readings = replace(readings, value=observable.predict(parameters.nominal, readings, nuisance))
    return Candidates(q, readings, stop, nuisance, sight.why, notes)


def _nuisance(observable: Observable, space: Space) -> Nuisance:
    """Return where the instruments are meant to stand, and the balls on the tool."""
    places = space.places or (Place((0.0, 0.0, 0.0)),)
    targets = space.targets
    if observable.kind == "relative" and len(targets) < 2:
        targets = np.vstack([targets, targets[0] + [BALLS_APART, 0, 0]])
    radius = getattr(observable, "radius", None)
    long = 0.03 if observable.kind == "sphere" and radius is None else float(radius or 0.0)
    return Nuisance(
        tuple(fixed_at(np.array(place.position)) for place in places),
        targets - targets[0], np.full(len(places), long),
    )  # fmt: skip


def _look(
    parameters: Parameters,
    observable: Observable,
    space: Space,
    nuisance: Nuisance,
    random: np.random.Generator,
    sight: _Sight,
) -> None:
    """Look at some random poses, each from a random place at a random target."""
    q = space.draw(DRAWN, random)
    stations, targets = len(nuisance.stations), len(nuisance.targets)
    first = 1 if observable.kind == "relative" else 0
    station = random.integers(0, stations, DRAWN)
    target = random.integers(first, targets, DRAWN)
    if observable.closes:
        readings = empty_readings(observable.kind, q, Loads(), station=station, target=target)
        touching = predicted_readings(observable, parameters.nominal, readings, nuisance)
        sight.looked += len(q) - len(touching)
        missed = sight.hindered.get("do not reach the fixed point", 0)
        sight.hindered["do not reach the fixed point"] = missed + len(q) - len(touching)
        q, station, target = touching.q, touching.station, touching.target
    good = np.ones(len(q), dtype=bool)
    for reason, hit in _hindrances(observable, space, q, station, target).items():
        sight.hindered[reason] = sight.hindered.get(reason, 0) + int(hit.sum())
        good &= ~hit
    sight.looked += len(q)
    sight.q.append(q[good])
    sight.station.append(station[good])
    sight.target.append(target[good])


def readable(observable: Observable, space: Space, readings: Readings) -> Mask:
    """Return which readings (N,) can be taken: nothing in the way, nothing hit."""
    hits = _hindrances(observable, space, readings.q, readings.station, readings.target)
    return np.asarray(~np.any(list(hits.values()), axis=0))


def _hindrances(
    observable: Observable, space: Space, q: Array, station: Index, target: Index
) -> dict[str, Mask]:
    found = space.hindrances(q)
    if space.places and not observable.closes:
        found |= _unseen(space, q, station, np.minimum(target, len(space.targets) - 1))
    return found


def joined(found: Candidates, more: Readings) -> Candidates:
    """Return the candidates with further readings, each at a pose of its own."""
    stop = np.concatenate([found.stop, len(found.q) + np.arange(len(more))])
    q = np.concatenate([found.q, more.q])
    return replace(found, q=q, readings=beside(found.readings, more), stop=stop)


def _unseen(space: Space, q: Array, station: Index, target: Index) -> dict[str, Mask]:
    """Return by reason which targets are not seen from their places."""
    found: dict[str, Mask] = {}
    for s in range(len(space.places)):
        for t in range(len(space.targets)):
            rows = np.flatnonzero((station == s) & (target == t))
            for reason, missed in space.sees(space.frames(q[rows]), s, t).items():
                whole = found.setdefault(reason, np.zeros(len(q), dtype=bool))
                whole[rows] |= missed
    return found


def _under_loads(
    parameters: Parameters,
    observable: Observable,
    loads: Sequence[Payload],
    seen: tuple[Array, Index, Index],
    random: np.random.Generator,
) -> tuple[Readings, Index]:
    """Return each pose under every load, from both sides where joints have play."""
    q, station, target = seen
    count = len(q)
    played = [j - 1 for j in parameters.sided()]
    sides: list[Array] = [np.zeros(q.shape)]
    if played:
        side = np.zeros(q.shape)
        side[:, played] = random.choice([-1.0, 1.0], (count, len(played)))
        sides = [side, -side]
    variants = [(number, side) for number in range(len(loads)) for side in sides]
    stop = np.tile(np.arange(count), len(variants))
    load = np.repeat([number for number, _ in variants], count)
    acting = Loads(
        payload_mass=np.array([one.mass for one in loads])[load],
        payload_cog=np.array([one.cog for one in loads], dtype=float)[load],
        approach=np.concatenate([side for _, side in variants]) if played else None,
    )
    columns = {"load": load, "station": station[stop], "target": target[stop], "pose": stop}
    return empty_readings(observable.kind, q[stop], acting, **columns), stop
