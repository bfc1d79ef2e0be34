"""Candidate readings of a plan: reachable poses visible to the instrument, under every load."""

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
    concatenated,
    predicted_readings,
    unmeasured_readings,
)
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Payload
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.errors import PlanError
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason
from gapbridge.core.workspace.workspace import Place, Rejection, RejectionReason, Workspace

STOPS = 900  # candidate poses
SAMPLES = 4000  # random poses drawn per round
MAX_ROUNDS = 40
EMPTY_ROUNDS = 6  # rounds without any accepted pose after which sampling stops
DEFAULT_BALL_DISTANCE = 0.2  # m, of two balls on the tool where it is not declared


class RejectedPoses(NamedTuple):
    """How many random poses were sampled, and the most frequent reasons for rejecting them."""

    sampled: int
    counts: tuple[tuple[str, int, int], ...]  # a RejectionReason's name, its number, poses

    def __str__(self) -> str:
        parts = [
            f"{100 * n / max(self.sampled, 1):.0f} % {RejectionReason[name].value.format(number)}"
            for name, number, n in self.counts
        ]
        return f"of {self.sampled} random poses " + (", ".join(parts) or "none can be read")


@dataclass(frozen=True)
class Candidates:
    """C poses, each under every load and, where joints have play, with opposite approaches."""

    q: Array  # (C, n) rad
    readings: Readings  # (R,) exact readings that the model predicts
    stop: Index  # (R,) number of the pose
    nuisance: Nuisance
    rejected: RejectedPoses
    notes: tuple[Note, ...]


class _PoseSampler:
    """Draws random poses and keeps those that can be measured; counts rejections by reason."""

    def __init__(
        self, nominal: Model, observable: Observable, workspace: Workspace, nuisance: Nuisance
    ) -> None:
        self._nominal, self._observable = nominal, observable
        self._workspace, self._nuisance = workspace, nuisance
        self._accepted: list[tuple[Array, Index, Index]] = []  # joints, place, target
        self._sampled = 0
        self._rejections: Counter[Rejection] = Counter()

    @property
    def count(self) -> int:
        """Return how many poses are accepted."""
        return sum(len(q) for q, _, _ in self._accepted)

    @property
    def rejected(self) -> RejectedPoses:
        """Return the three most frequent reasons."""
        most = self._rejections.most_common(3)
        return RejectedPoses(
            self._sampled, tuple((one.reason.name, one.number, n) for one, n in most if n)
        )

    def first(self, most: int) -> tuple[Array, Index, Index]:
        """Return joints (C, n), place (C,) and target (C,) of the first ``most``."""
        q, station, target = (
            np.concatenate(parts)[:most] for parts in zip(*self._accepted, strict=True)
        )
        return q, station, target

    def sample(self, random: np.random.Generator) -> None:
        """Draw random poses, each measured from a random place at a random target."""
        observable, nuisance = self._observable, self._nuisance
        q = self._workspace.draw(SAMPLES, random)
        self._sampled += SAMPLES
        first = 1 if observable.kind == "relative" else 0
        station = random.integers(0, len(nuisance.stations), SAMPLES)
        target = random.integers(first, len(nuisance.targets), SAMPLES)
        if observable.closes:
            readings = unmeasured_readings(
                observable.kind, q, Loads(), station=station, target=target
            )
            touching = predicted_readings(observable, self._nominal, readings, nuisance)
            self._rejections[Rejection(RejectionReason.FIXED_POINT)] += SAMPLES - len(touching)
            q, station, target = touching.q, touching.station, touching.target
        good = np.ones(len(q), dtype=bool)
        for reason, hit in _rejections_of(observable, self._workspace, q, station, target).items():
            self._rejections[reason] += int(hit.sum())
            good &= ~hit
        self._accepted.append((q[good], station[good], target[good]))


def sample_candidates(
    parameters: Parameters,
    observable: Observable,
    loads: Sequence[Payload],
    workspace: Workspace,
    seed: int,
    stops: int = STOPS,
) -> Candidates:
    """Return candidates at up to ``stops`` poses.

    Raises PlanError where no pose is reachable and visible.
    """
    if observable.unknown and not workspace.places:
        raise PlanError(
            f"places: found none, expected where in base the fixed point of the {observable.kind} "
            "readings is"
        )
    nuisance = _nominal_nuisance(observable, workspace)
    random = np.random.default_rng(seed)
    sampler = _PoseSampler(parameters.nominal, observable, workspace, nuisance)
    for round_number in range(MAX_ROUNDS):
        sampler.sample(random)
        if sampler.count >= stops or (round_number >= EMPTY_ROUNDS and not sampler.count):
            break
    if not sampler.count:
        raise PlanError(f"no pose is reachable and visible: {sampler.rejected}")
    accepted = sampler.first(stops)
    readings, stop = _with_loads(parameters, observable, loads, accepted, random)
    notes = () if sampler.count >= stops else (Note(Reason.FEW_POSES, (sampler.rejected,)),)
    readings = replace(readings, value=observable.predict(parameters.nominal, readings, nuisance))
    return Candidates(accepted[0], readings, stop, nuisance, sampler.rejected, notes)


def _nominal_nuisance(observable: Observable, workspace: Workspace) -> Nuisance:
    """Return the planned places of the instruments, and the balls on the tool."""
    places = workspace.places or (Place((0.0, 0.0, 0.0)),)
    targets = workspace.targets
    if observable.kind == "relative" and len(targets) < 2:
        targets = np.vstack([targets, targets[0] + [DEFAULT_BALL_DISTANCE, 0, 0]])
    radius = getattr(observable, "radius", None)
    length = 0.03 if observable.kind == "sphere" and radius is None else float(radius or 0.0)
    return Nuisance(
        tuple(fixed_at(np.array(place.position)) for place in places),
        targets - targets[0], np.full(len(places), length),
    )  # fmt: skip


def measurable(observable: Observable, workspace: Workspace, readings: Readings) -> Mask:
    """Return which readings (N,) can be taken: target visible, no collision."""
    hits = _rejections_of(observable, workspace, readings.q, readings.station, readings.target)
    return np.asarray(~np.any(list(hits.values()), axis=0))


def _rejections_of(
    observable: Observable, workspace: Workspace, q: Array, station: Index, target: Index
) -> dict[Rejection, Mask]:
    rejections = workspace.rejections(q)
    if workspace.places and not observable.closes:
        rejections |= _not_visible(
            workspace, q, station, np.minimum(target, len(workspace.targets) - 1)
        )
    return rejections


def with_readings(candidates: Candidates, more: Readings) -> Candidates:
    """Return the candidates with further readings, each at a separate pose."""
    stop = np.concatenate([candidates.stop, len(candidates.q) + np.arange(len(more))])
    q = np.concatenate([candidates.q, more.q])
    return replace(candidates, q=q, readings=concatenated(candidates.readings, more), stop=stop)


def _not_visible(
    workspace: Workspace, q: Array, station: Index, target: Index
) -> dict[Rejection, Mask]:
    """Return by reason which targets are not visible from their places."""
    masks: dict[Rejection, Mask] = {}
    for s in range(len(workspace.places)):
        for t in range(len(workspace.targets)):
            rows = np.flatnonzero((station == s) & (target == t))
            for reason, missed in workspace.not_visible(workspace.frames(q[rows]), s, t).items():
                mask = masks.setdefault(reason, np.zeros(len(q), dtype=bool))
                mask[rows] |= missed
    return masks


def _with_loads(
    parameters: Parameters,
    observable: Observable,
    loads: Sequence[Payload],
    poses: tuple[Array, Index, Index],
    random: np.random.Generator,
) -> tuple[Readings, Index]:
    """Return each pose under every load, approached from both sides where joints have play."""
    q, station, target = poses
    count = len(q)
    with_play = [j - 1 for j in parameters.approach_joints()]
    approaches: list[Array] = [np.zeros(q.shape)]
    if with_play:
        approach = np.zeros(q.shape)
        approach[:, with_play] = random.choice([-1.0, 1.0], (count, len(with_play)))
        approaches = [approach, -approach]
    variants = [(number, approach) for number in range(len(loads)) for approach in approaches]
    stop = np.tile(np.arange(count), len(variants))
    load = np.repeat([number for number, _ in variants], count)
    loads_of_rows = Loads(
        payload_mass=np.array([one.mass for one in loads])[load],
        payload_cog=np.array([one.cog for one in loads], dtype=float)[load],
        approach=np.concatenate([approach for _, approach in variants]) if with_play else None,
    )
    columns = {"load": load, "station": station[stop], "target": target[stop], "pose": stop}
    return unmeasured_readings(observable.kind, q[stop], loads_of_rows, **columns), stop
