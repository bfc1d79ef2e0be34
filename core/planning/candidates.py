"""Candidate readings of a plan: reachable poses that the instrument sees, under every load."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

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
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason
from gapbridge.core.planning.workspace import Hindrance, Obstacle, Place, Workspace

STOPS = 900  # candidate poses
DRAWN = 4000  # random poses looked at in one go
TRIES = 40
HOPELESS = 6  # tries without any pose after which none is expected
BALLS_APART = 0.2  # m, of two balls on the tool where nobody says it


class Hindered(NamedTuple):
    """Random poses that were looked at, and what stands against most of them."""

    looked: int
    poses: tuple[tuple[str, int, int], ...]  # an Obstacle's name, its number, poses

    def __str__(self) -> str:
        parts = [
            f"{100 * n / max(self.looked, 1):.0f} % {Obstacle[name].value.format(number)}"
            for name, number, n in self.poses
        ]
        return f"of {self.looked} random poses " + (", ".join(parts) or "none can be read")


@dataclass(frozen=True)
class Candidates:
    """C poses, each under every load and, where joints have play, with opposite approaches."""

    q: Array  # (C, n) rad
    readings: Readings  # (R,) exact readings that the model predicts
    stop: Index  # (R,) number of the pose
    nuisance: Nuisance
    hindered: Hindered
    notes: tuple[Note, ...]


class _Sight:
    """Random poses that can be read, found so far, and what hindered the others."""

    def __init__(
        self, nominal: Model, observable: Observable, workspace: Workspace, nuisance: Nuisance
    ) -> None:
        self._nominal, self._observable = nominal, observable
        self._workspace, self._nuisance = workspace, nuisance
        self._found: list[tuple[Array, Index, Index]] = []  # joints, place, target
        self._looked = 0
        self._hindered: Counter[Hindrance] = Counter()

    @property
    def count(self) -> int:
        """Return how many there are."""
        return sum(len(q) for q, _, _ in self._found)

    @property
    def hindered(self) -> Hindered:
        """Return what hinders random poses most."""
        most = self._hindered.most_common(3)
        return Hindered(self._looked, tuple((h.obstacle.name, h.number, n) for h, n in most if n))

    def first(self, most: int) -> tuple[Array, Index, Index]:
        """Return joints (C, n), place (C,) and target (C,) of the first ``most``."""
        q, station, target = (
            np.concatenate(parts)[:most] for parts in zip(*self._found, strict=True)
        )
        return q, station, target

    def look(self, random: np.random.Generator) -> None:
        """Look at some random poses, each from a random place at a random target."""
        observable, nuisance = self._observable, self._nuisance
        q = self._workspace.draw(DRAWN, random)
        self._looked += DRAWN
        first = 1 if observable.kind == "relative" else 0
        station = random.integers(0, len(nuisance.stations), DRAWN)
        target = random.integers(first, len(nuisance.targets), DRAWN)
        if observable.closes:
            readings = empty_readings(observable.kind, q, Loads(), station=station, target=target)
            touching = predicted_readings(observable, self._nominal, readings, nuisance)
            self._hindered[Hindrance(Obstacle.FIXED_POINT)] += DRAWN - len(touching)
            q, station, target = touching.q, touching.station, touching.target
        good = np.ones(len(q), dtype=bool)
        for hindrance, hit in _hindrances(observable, self._workspace, q, station, target).items():
            self._hindered[hindrance] += int(hit.sum())
            good &= ~hit
        self._found.append((q[good], station[good], target[good]))


def candidates_of(
    parameters: Parameters,
    observable: Observable,
    loads: Sequence[Payload],
    workspace: Workspace,
    seed: int,
    stops: int = STOPS,
) -> Candidates:
    """Return candidates at up to ``stops`` poses.

    Raises PlanError where no pose is reachable and seen.
    """
    if observable.unknown and not workspace.places:
        raise PlanError(
            f"places: found none, expected where in base the fixed point of the {observable.kind} "
            "readings is"
        )
    nuisance = _nuisance(observable, workspace)
    random = np.random.default_rng(seed)
    sight = _Sight(parameters.nominal, observable, workspace, nuisance)
    for tried in range(TRIES):
        sight.look(random)
        if sight.count >= stops or (tried >= HOPELESS and not sight.count):
            break
    if not sight.count:
        raise PlanError(f"no pose can be reached and seen: {sight.hindered}")
    seen = sight.first(stops)
    readings, stop = _under_loads(parameters, observable, loads, seen, random)
    notes = () if sight.count >= stops else (Note(Reason.FEW_POSES, (sight.hindered,)),)
    readings = replace(readings, value=observable.predict(parameters.nominal, readings, nuisance))
    return Candidates(seen[0], readings, stop, nuisance, sight.hindered, notes)


def _nuisance(observable: Observable, workspace: Workspace) -> Nuisance:
    """Return where the instruments are meant to stand, and the balls on the tool."""
    places = workspace.places or (Place((0.0, 0.0, 0.0)),)
    targets = workspace.targets
    if observable.kind == "relative" and len(targets) < 2:
        targets = np.vstack([targets, targets[0] + [BALLS_APART, 0, 0]])
    radius = getattr(observable, "radius", None)
    long = 0.03 if observable.kind == "sphere" and radius is None else float(radius or 0.0)
    return Nuisance(
        tuple(fixed_at(np.array(place.position)) for place in places),
        targets - targets[0], np.full(len(places), long),
    )  # fmt: skip


def readable(observable: Observable, workspace: Workspace, readings: Readings) -> Mask:
    """Return which readings (N,) can be taken: nothing in the way, nothing hit."""
    hits = _hindrances(observable, workspace, readings.q, readings.station, readings.target)
    return np.asarray(~np.any(list(hits.values()), axis=0))


def _hindrances(
    observable: Observable, workspace: Workspace, q: Array, station: Index, target: Index
) -> dict[Hindrance, Mask]:
    found = workspace.hindrances(q)
    if workspace.places and not observable.closes:
        found |= _unseen(workspace, q, station, np.minimum(target, len(workspace.targets) - 1))
    return found


def joined(found: Candidates, more: Readings) -> Candidates:
    """Return the candidates with further readings, each at a pose of its own."""
    stop = np.concatenate([found.stop, len(found.q) + np.arange(len(more))])
    q = np.concatenate([found.q, more.q])
    return replace(found, q=q, readings=beside(found.readings, more), stop=stop)


def _unseen(workspace: Workspace, q: Array, station: Index, target: Index) -> dict[Hindrance, Mask]:
    """Return by hindrance which targets are not seen from their places."""
    found: dict[Hindrance, Mask] = {}
    for s in range(len(workspace.places)):
        for t in range(len(workspace.targets)):
            rows = np.flatnonzero((station == s) & (target == t))
            for hindrance, missed in workspace.sees(workspace.frames(q[rows]), s, t).items():
                whole = found.setdefault(hindrance, np.zeros(len(q), dtype=bool))
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
