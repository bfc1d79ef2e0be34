"""Separation: the measurements that would decide what these data leave open.

Poses, loads and motions are drawn within the arm's limits. Those are proposed where two
explanations that fit the log alike, or the model with and without an effect that the log cannot
show, predict readings furthest apart, in multiples of the noise. The frame of an unregistered
instrument is the one that each explanation needs on the log: what a frame can take up decides
nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis
from gapbridge.core.diagnosis.criteria import DECISIVE, TIE_SCORE
from gapbridge.core.diagnosis.next_measurements import PREDICTED, Predict, Trials, draw_trials
from gapbridge.core.diagnosis.selection.local_search import rivals
from gapbridge.core.diagnosis.selection.problem import CandidateFit, SampleSpace, fit
from gapbridge.core.effects import CATALOGUE, Site, Term
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.least_squares import solve
from gapbridge.core.estimation.registration import frame_columns
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model

EACH = 2  # measurements proposed per open question
APART = 0.5  # rad, of some joint, between poses that are proposed together
POSED = 1e-6  # share of a difference that changes with the pose: less, and no pose decides


@dataclass(frozen=True)
class Measurement:
    """One pose and load worth measuring."""

    q: tuple[float, ...]  # rad
    payload: float  # kg
    separates: tuple[str, ...]
    expected_gain: float  # distance of the rivals' predictions there, in standard deviations
    approach: tuple[int, ...] | None = None  # last motion of each joint, where it matters
    velocity: tuple[float, ...] | None = None  # rad/s through the pose, where it has to move
    acceleration: tuple[float, ...] | None = None  # rad/s2 there


@dataclass(frozen=True)
class _Question:
    """Two explanations, and the effects between which they decide."""

    separates: tuple[str, ...]
    one: tuple[Term, ...]
    other: tuple[Term, ...]


def next_measurements(
    model: Model, log: Log, channels: Sequence[ChannelDiagnosis], seed: int = 0
) -> tuple[Measurement, ...]:
    """Return poses and loads, within the joint limits, that decide ties or excite the silent.

    Motions through the poses where the log records motion; at rest else, where no pose shows how
    encoders follow.
    """
    chosen: list[Measurement] = []
    drawn = draw_trials(model, log, seed)
    for channel in channels:
        moving = channel.selection.observation.order_in_time
        if channel.channel == "tracking" and not moving:
            continue
        trials = drawn if moving else drawn.at_rest
        predict = PREDICTED[channel.channel](model, trials)
        sigma = channel.noise_floor_rms or channel.selection.observation.sigma or 1e-5
        for question in _questions(model, channel, trials, predict):
            difference = _difference(channel, trials, predict, question)
            if difference is None:
                continue
            gain = np.linalg.norm(difference, axis=1) / sigma
            chosen += _best(moving, trials, question.separates, gain)
    return tuple(chosen)


def _questions(
    model: Model, channel: ChannelDiagnosis, trials: Trials, predict: Predict
) -> Iterator[_Question]:
    """Yield what is open: effects to be separated, and effects that the log cannot show."""
    selection = channel.selection
    space, found = selection.working, selection.found
    for position in channel.judgement.accused:
        own = selection.term_index[position]
        if own in selection.block:  # nothing stands for all links but they themselves
            continue
        family = selection.terms[position].effect
        chosen = {family}
        rest = tuple(c for c in found.chosen if c != own)
        for _, other in rivals(space, found, own, TIE_SCORE):
            candidate = space.candidates[other]
            if candidate.named and candidate.family not in chosen:
                chosen.add(candidate.family)
                swapped = fit(space, (*rest, other))
                yield _Question(
                    (family, candidate.family), _named(space, found), _named(space, swapped)
                )
    accused = tuple(selection.terms[p] for p in channel.judgement.accused)
    for considered in channel.considered:
        if not considered.excited:
            for usual in _usual(model, considered.effect):
                question = _Question((considered.effect,), (*accused, usual), accused)
                if _difference(channel, trials, predict, question) is not None:
                    yield question
                    break


def _named(space: SampleSpace, found: CandidateFit) -> tuple[Term, ...]:
    return tuple(
        space.candidates[c].term(x)
        for c, x in zip(found.chosen, found.values, strict=True)
        if space.candidates[c].named
    )


def _usual(model: Model, effect: str) -> Iterator[Term]:
    """Yield an effect of usual size at each of its sites."""
    member = CATALOGUE[effect]
    for site in member.sites(model.arm):
        place = Site(site.joint, 1.0 if member.periodic else None)
        yield Term(effect, place, tuple(p.scale for p in member.parameters(model.arm, place)))


def _difference(
    channel: ChannelDiagnosis, trials: Trials, predict: Predict, question: _Question
) -> Array | None:
    """Return how the readings of two explanations differ (N, k); None where no pose decides."""
    observation = channel.selection.observation
    try:
        apart = predict(question.one) - predict(question.other)
        if observation.nuisance.shape[2] >= 6:
            seen = observation.predict(question.one) - observation.predict(question.other)
            apart = apart - _framed(observation.nuisance, seen, predict(question.other))
    except InputError:  # the arm would buckle under one of them
        return None
    apart = apart * observation.weight[: apart.shape[1]]
    spread, size = float(np.ptp(apart, axis=0).max()), float(np.abs(apart).max())
    return apart if spread > POSED * max(size, 1e-300) else None


def _framed(nuisance: Array, seen: Array, position: Array) -> Array:
    """Return how the frame that takes up the log's difference moves the readings of trials."""
    A = nuisance[:, :3].reshape(-1, nuisance.shape[2])
    # of several sessions the trials go on with the first one's frame
    x = solve(A, seen[:, :3].ravel())[:6]
    return np.asarray(-frame_columns(position)[:, :3] @ x)


def _best(moving: bool, trials: Trials, names: tuple[str, ...], gain: Array) -> list[Measurement]:
    chosen: list[Measurement] = []
    q, loads = trials.q, trials.loads
    assert loads.payload_mass is not None and loads.approach is not None
    for r in np.argsort(-gain):
        if gain[r] < DECISIVE or len(chosen) == EACH:
            break
        if all(np.abs(q[r] - np.array(m.q)).max() > APART for m in chosen):
            sided = any(CATALOGUE[name].by_approach for name in names)
            approach = tuple(int(v) for v in loads.approach[r]) if sided else None
            chosen.append(Measurement(
                _floats(q[r]), float(loads.payload_mass[r]), names, float(gain[r]), approach,
                velocity=_floats(trials.qd[r]) if moving else None,
                acceleration=_floats(trials.qdd[r]) if moving else None,
            ))  # fmt: skip
    return chosen


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
