"""Separation: the measurements that would decide what these data leave open.

Poses and loads are drawn within the arm's limits. Those are proposed where two explanations that
fit the log alike, or the model with and without an effect that the log cannot show, predict
readings furthest apart, in multiples of the noise. The frame of an unregistered instrument is the
one that each explanation needs on the log: what a frame can take up decides nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from core.diagnosis.neighbours import rivals
from core.diagnosis.space import Found, Space, fit
from core.dynamics import predict_wrench, with_pieces
from core.effects import CATALOGUE, Site, Term
from core.errors import InputError
from core.loads import Loads
from core.log import Log
from core.model import Model
from core.motion import Motion
from core.registration import frame_columns

if TYPE_CHECKING:
    from core.diagnosis.diagnosis import ChannelDiagnosis

Array = NDArray[np.float64]
Predict = Callable[[Sequence[Term]], Array]
POSES = 160
EACH = 2  # measurements proposed per open question
APART = 0.5  # rad, of some joint, between poses that are proposed together
TIE = 7.0
VISIBLE = 1.0  # times the noise: a smaller difference decides nothing
POSED = 1e-6  # share of a difference that changes with the pose: less, and no pose decides


@dataclass(frozen=True)
class Measurement:
    """One pose and load worth measuring."""

    q: tuple[float, ...]  # rad
    payload: float  # kg
    separates: tuple[str, ...]
    expected_gain: float  # distance of the rivals' predictions there, in standard deviations
    approach: tuple[int, ...] | None = None  # last motion of each joint, where it matters


@dataclass(frozen=True)
class _Trials:
    """Poses and loads that could be measured."""

    q: Array  # (N, n)
    loads: Loads
    time: float  # s, of the measurement
    start: float  # s, of the log


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

    For the channels that show at rest: position and wrench.
    """
    told: list[Measurement] = []
    trials = _trials(model, log, seed)
    for channel in channels:
        if channel.channel not in PREDICTED:
            continue
        predict = PREDICTED[channel.channel](model, trials)
        sigma = channel.noise_floor_rms or channel.selection.observation.sigma or 1e-5
        for question in _questions(model, channel, trials, predict):
            difference = _difference(channel, trials, predict, question)
            if difference is None:
                continue
            gain = np.linalg.norm(difference, axis=1) / sigma
            told += _best(trials, question.separates, gain)
    return tuple(told)


def _trials(model: Model, log: Log, seed: int) -> _Trials:
    rng = np.random.default_rng(seed)
    low, high = _range(model)
    q = rng.uniform(low, high, (POSES, model.arm.n))
    rated = model.arm.payload if np.isfinite(model.arm.payload) else 0.0
    mass, cog, warm = (log.get(name) for name in ("payload", "payload_cog", "joint_temperatures"))
    most = max(rated, model.payload_mass, 0.0 if mass is None else float(np.nanmax(mass)))
    masses = np.array([0.0, 0.5, 1.0])[rng.integers(0, 3, POSES)] * most
    time = log.get("timestamp")
    loads = Loads(
        payload_mass=masses,
        payload_cog=np.tile(model.payload_cog if cog is None else cog[-1], (POSES, 1)),
        temperature=None if warm is None else np.tile(warm[-1], (POSES, 1)),
        approach=rng.choice([-1.0, 1.0], (POSES, model.arm.n)),
    )
    end, start = (0.0, 0.0) if time is None else (float(time[-1]), float(time[0]))
    return _Trials(q, loads, end, start)


def _range(model: Model) -> tuple[Array, Array]:
    """Return where each joint may stand (n,), (n,): one turn at most, about zero if it may."""
    # numbers so large that nothing is lost stand for "no limit": their sum is still a number
    low, high = (
        np.clip(side, -1e6, 1e6) for side in (model.arm.limits.lower, model.arm.limits.upper)
    )
    half = np.minimum(np.pi, (high - low) / 2)
    middle = np.clip(0.0, low + half, high - half)
    return middle - half, middle + half


def _questions(
    model: Model, channel: ChannelDiagnosis, trials: _Trials, predict: Predict
) -> Iterator[_Question]:
    """Yield what is open: effects to be told apart, and effects that the log cannot show."""
    selection = channel.selection
    space, found = selection.space, selection.found
    for position in channel.judgement.accused:
        own = selection.term_index[position]
        family = selection.terms[position].effect
        told = {family}
        rest = tuple(c for c in found.chosen if c != own)
        for _, other in rivals(space, found, own, TIE):
            candidate = space.candidates[other]
            if candidate.named and candidate.family not in told:
                told.add(candidate.family)
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


def _named(space: Space, found: Found) -> tuple[Term, ...]:
    return tuple(
        space.candidates[c].term(x)
        for c, x in zip(found.chosen, found.values, strict=True)
        if space.candidates[c].named
    )


def _usual(model: Model, effect: str) -> Iterator[Term]:
    """Yield an effect of usual size at each of its sites."""
    member = CATALOGUE[effect]
    for site in member.sites(model.arm):
        place = Site(site.joint, 1.0 if effect == "transmission_error" else None)
        yield Term(effect, place, tuple(p.scale for p in member.parameters(model.arm, place)))


def _difference(
    channel: ChannelDiagnosis, trials: _Trials, predict: Predict, question: _Question
) -> Array | None:
    """Return how the readings of two explanations differ (N, k); None where no pose decides."""
    observation = channel.selection.observation
    try:
        apart = predict(question.one) - predict(question.other)
        if observation.nuisance.shape[2]:
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
    x = np.linalg.lstsq(A, seen[:, :3].ravel(), rcond=1e-9)[0]
    return np.asarray(-frame_columns(position)[:, :3] @ x)


def _best(trials: _Trials, names: tuple[str, ...], gain: Array) -> list[Measurement]:
    told: list[Measurement] = []
    q, loads = trials.q, trials.loads
    assert loads.payload_mass is not None and loads.approach is not None
    for r in np.argsort(-gain):
        if gain[r] < VISIBLE or len(told) == EACH:
            break
        if all(np.abs(q[r] - np.array(m.q)).max() > APART for m in told):
            approach = tuple(int(v) for v in loads.approach[r]) if "backlash" in names else None
            pose = tuple(float(v) for v in q[r])
            load = float(loads.payload_mass[r])
            told.append(Measurement(pose, load, names, float(gain[r]), approach))
    return told


def _positions(model: Model, trials: _Trials) -> Predict:
    return lambda terms: model.with_terms(terms).predict(trials.q, trials.loads).position


def _wrenches(model: Model, trials: _Trials) -> Predict:
    count, n = trials.q.shape
    motion = Motion(
        t=np.full(count, trials.time), q=trials.q, qd=np.zeros((count, n)),
        qdd=np.zeros((count, n)), target_q=None, loads=trials.loads, rows=np.arange(count),
        valid=np.ones(count, dtype=bool), stretch=np.zeros(count, dtype=np.int64),
        start=trials.start, moving=False, still=np.ones(n),
    )  # fmt: skip
    motion = with_pieces(model, motion)
    return lambda terms: predict_wrench(model, motion, terms)


PREDICTED: dict[str, Callable[[Model, _Trials], Predict]] = {
    "position": _positions,
    "wrench": _wrenches,
}
