"""Separation: measurements that would distinguish tied explanations.

Random poses, loads and motions within the arm's limits are compared. Those are proposed at which
two explanations that fit the log equally well, or the model with and without an effect that the log
does not excite, predict the most different readings, in multiples of the noise. The frame of an
unregistered instrument is refitted on the log for each explanation, so that a difference that a
frame absorbs does not count.

Trials are poses at rest, or in recordings short motions through a pose, at a feasible speed and
acceleration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis
from gapbridge.core.diagnosis.criteria import MIN_SEPARATION
from gapbridge.core.diagnosis.finding import Check
from gapbridge.core.diagnosis.selection.sample_space import CandidateFit, SampleSpace, fit
from gapbridge.core.diagnosis.ties import tied
from gapbridge.core.dynamics import (
    predict_torque,
    predict_tracking,
    predict_wrench,
    with_holding_torque,
    with_pieces,
)
from gapbridge.core.effects import CATALOGUE, Site, Term
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.least_squares import solve
from gapbridge.core.estimation.registration import frame_columns
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion
from gapbridge.core.workspace.workspace import clear_of_itself

PER_QUESTION = 2  # measurements proposed per open question
MIN_POSE_DISTANCE = 0.5  # rad, of some joint, between proposed poses
MIN_POSE_DEPENDENCE = 1e-6  # share of a difference that has to depend on the pose
Predict = Callable[[Sequence[Term]], Array]
POSES = 160
DRAWN = 4 * POSES  # of which those are left out at which the arm meets itself
MAX_SPEED_SHARE = 0.7  # of a joint's speed limit, in a trial
ACCELERATION_TIME = 0.25  # s from rest to the speed limit, at least
DEFAULT_MAX_SPEED = 2.0  # rad/s for joints without a speed limit
LEAD, STEP = 0.5, 0.004  # s: duration and sampling of a trial's motion before its pose
BEFORE = np.arange(-round(LEAD / STEP), 1)[:, None, None] * STEP  # s, of its samples
WAY = 5  # places on it that are checked for the arm itself
STILL = 0.02  # share of the speed limit below which the direction of motion is uncertain


@dataclass(frozen=True)
class Measurement:
    """A proposed measurement: pose and load, in motion also velocity and acceleration."""

    q: tuple[float, ...]  # rad
    payload: float  # kg
    separates: tuple[str, ...]
    expected_gain: float  # difference of the two predictions, in standard deviations
    approach: tuple[int, ...] | None = None  # last motion of each joint; None: any
    velocity: tuple[float, ...] | None = None  # rad/s through the pose; None: at rest
    acceleration: tuple[float, ...] | None = None  # rad/s2 there


@dataclass(frozen=True)
class _OpenQuestion:
    """Two explanations to be separated, and the effects in which they differ."""

    separates: tuple[str, ...]
    first: tuple[Term, ...]
    second: tuple[Term, ...]


def next_measurements(
    model: Model, log: Log, channels: Sequence[ChannelDiagnosis], seed: int = 0
) -> tuple[Measurement, ...]:
    """Return poses and loads that resolve ties or excite other effects.

    They are within the joint limits, and clear of the arm itself by its coarse shape. Motions
    through the poses if the log is a recording; else poses at rest, without tracking.
    """
    chosen: list[Measurement] = []
    drawn = draw_trials(model, log, seed)
    for channel in channels:
        moving = channel.selection.observation.order_in_time and channel.channel != "position"
        if channel.channel == "tracking" and not moving:
            continue
        trials = drawn if moving else drawn.at_rest
        predict = PREDICTORS[channel.channel](model, trials)
        sigma = _noise(channel)
        for question in _open_questions(model, channel, predict):
            difference = _difference(channel, predict, question)
            if difference is None:
                continue
            gain = np.linalg.norm(difference, axis=1) / sigma
            chosen += _best(moving, trials, question.separates, gain)
    # one pose may answer the same question of several joints
    return tuple({(m.q, m.separates): m for m in chosen}.values())


def _noise(channel: ChannelDiagnosis) -> float:
    """Return a channel's noise, rms of a coordinate; of its search where no floor is known."""
    selection = channel.selection
    if known := channel.noise_floor_rms or selection.observation.sigma:
        return known
    spread = np.diagonal(selection.unwhitener(), axis1=1, axis2=2) * selection.observation.weight
    return float(np.sqrt(np.mean(spread**2))) or 1e-5


def _open_questions(
    model: Model, channel: ChannelDiagnosis, predict: Predict
) -> Iterator[_OpenQuestion]:
    """Yield the ties of effects, accused or for that not, and effects that the log lacks."""
    selection = channel.selection
    space, best = selection.working, selection.best
    judgement = channel.judgement
    separated = [p for p, why in judgement.withdrawn if why.failed is Check.SEPARATED]
    for position in (*judgement.accused, *separated):
        accused_candidate = selection.term_index[position]
        if accused_candidate in selection.block:  # no rivals
            continue
        family = selection.terms[position].effect
        rest = tuple(c for c in best.chosen if c != accused_candidate)
        for other in tied(selection, accused_candidate):
            if other not in rest:
                names = (family, space.candidates[other].family)
                swapped = fit(space, (*rest, other))
                yield _OpenQuestion(names, _named(space, best), _named(space, swapped))
    accused = tuple(selection.terms[p] for p in channel.judgement.accused)
    for considered in channel.considered:
        if not considered.excited:
            for usual in _terms_of_usual_size(model, considered.effect):
                question = _OpenQuestion((considered.effect,), (*accused, usual), accused)
                if _difference(channel, predict, question) is not None:
                    yield question
                    break


def _named(space: SampleSpace, best: CandidateFit) -> tuple[Term, ...]:
    return tuple(
        space.candidates[c].term(x)
        for c, x in zip(best.chosen, best.values, strict=True)
        if space.candidates[c].named
    )


def _terms_of_usual_size(model: Model, effect: str) -> Iterator[Term]:
    """Yield an effect of usual size at each of its sites."""
    member = CATALOGUE[effect]
    for site in member.sites(model.arm):
        place = Site(site.joint, 1.0 if member.periodic else None)
        yield Term(effect, place, tuple(p.scale for p in member.parameters(model.arm, place)))


def _difference(
    channel: ChannelDiagnosis, predict: Predict, question: _OpenQuestion
) -> Array | None:
    """Return the difference (N, k) of two explanations; None if it does not depend on the pose."""
    observation = channel.selection.observation
    try:
        apart = predict(question.first) - predict(question.second)
        if observation.free_frame:
            on_log = observation.predict(question.first) - observation.predict(question.second)
            position = predict(question.second)
            apart = apart - _frame_correction(observation.nuisance, on_log, position)
    except InputError:  # no equilibrium under one of them
        return None
    apart = apart * observation.weight[: apart.shape[1]]
    spread, size = float(np.ptp(apart, axis=0).max()), float(np.abs(apart).max())
    return apart if spread > MIN_POSE_DEPENDENCE * max(size, 1e-300) else None


def _frame_correction(nuisance: Array, on_log: Array, position: Array) -> Array:
    """Return the change of the trials' readings by the frame fitted to the log's difference."""
    A = nuisance[:, :3].reshape(-1, nuisance.shape[2])
    # of several sessions the trials are in the first one's frame
    x = solve(A, on_log[:, :3].ravel())[:6]
    return np.asarray(-frame_columns(position)[:, :3] @ x)


def _best(moving: bool, trials: Trials, names: tuple[str, ...], gain: Array) -> list[Measurement]:
    chosen: list[Measurement] = []
    q, loads = trials.q, trials.loads
    assert loads.payload_mass is not None and loads.approach is not None
    for r in np.argsort(-gain):
        if gain[r] < MIN_SEPARATION or len(chosen) == PER_QUESTION:
            break
        if all(np.abs(q[r] - np.array(m.q)).max() > MIN_POSE_DISTANCE for m in chosen):
            sided = any(CATALOGUE[name].depends_on_approach for name in names)
            approach = tuple(int(v) for v in loads.approach[r]) if sided else None
            chosen.append(Measurement(
                _floats(q[r]), float(loads.payload_mass[r]), names, float(gain[r]), approach,
                velocity=_floats(trials.qd[r]) if moving else None,
                acceleration=_floats(trials.qdd[r]) if moving else None,
            ))  # fmt: skip
    return chosen


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)


@dataclass(frozen=True)
class Trials:
    """Random poses, loads and motions that could be measured."""

    q: Array  # (N, n)
    loads: Loads
    qd: Array  # (N, n) rad/s through the pose; 0 at rest
    qdd: Array  # (N, n) rad/s2 there
    time: float  # s, of the measurement
    start: float  # s, of the log

    @property
    def at_rest(self) -> Trials:
        """Return the same poses and loads without motion."""
        nothing = np.zeros_like(self.q)
        return replace(self, qd=nothing, qdd=nothing)


def draw_trials(model: Model, log: Log, seed: int) -> Trials:
    """Return random trials within the joint limits and the rated load, clear of the arm itself."""
    rng = np.random.default_rng(seed)
    low, high = _range(model)
    q = rng.uniform(low, high, (DRAWN, model.arm.n))
    fastest = max_speed(model)
    qd = MAX_SPEED_SHARE * fastest * rng.uniform(-1.0, 1.0, q.shape)
    # limited so that the trial does not begin above the speed limit
    qdd = np.clip(
        rng.uniform(-1.0, 1.0, q.shape) * fastest / ACCELERATION_TIME,
        (qd - fastest) / LEAD, (qd + fastest) / LEAD,
    )  # fmt: skip
    slower = _within_limits(model, q, qd, qdd)
    qd, qdd = slower * qd, slower * qdd
    kept = _clear(model, q, qd, qdd)
    q, qd, qdd = q[kept], qd[kept], qdd[kept]
    rated = model.arm.payload if np.isfinite(model.arm.payload) else 0.0
    mass, cog, warm = (log.get(name) for name in ("payload", "payload_cog", "joint_temperatures"))
    most = max(rated, model.payload_mass, 0.0 if mass is None else float(np.nanmax(mass)))
    masses = np.array([0.0, 0.5, 1.0])[rng.integers(0, 3, len(q))] * most
    time = log.get("timestamp")
    loads = Loads(
        payload_mass=masses,
        payload_cog=np.tile(model.payload_cog if cog is None else cog[-1], (len(q), 1)),
        temperature=None if warm is None else np.tile(warm[-1], (len(q), 1)),
        approach=rng.choice([-1.0, 1.0], q.shape),
    )
    end, start = (0.0, 0.0) if time is None else (float(time[-1]), float(time[0]))
    return Trials(q, loads, qd, qdd, end, start)


def _within_limits(model: Model, q: Array, qd: Array, qdd: Array) -> Array:
    """Return the factors (N, n), 0 to 1, on a motion that keep it within the joint limits.

    On its way to the pose, and where it brakes behind it.
    """
    limits = model.arm.limits
    way = qd * BEFORE + 0.5 * qdd * BEFORE**2  # (k, N, n)
    brake = 0.5 * qd * np.abs(qd) * ACCELERATION_TIME / max_speed(model)
    factor = np.ones_like(q)
    for side, limit in ((1.0, limits.upper), (-1.0, limits.lower)):
        room = np.maximum(side * (limit - q), 0.0)
        reached = np.maximum((side * way).max(axis=0), 1e-9)
        behind = np.maximum(side * brake, 1e-9)
        factor = np.minimum(factor, np.minimum(room / reached, np.sqrt(room / behind)))
    return factor


def _clear(model: Model, q: Array, qd: Array, qdd: Array) -> Index:
    """Return the first POSES motions on whose way the arm does not meet itself; else any."""
    before = np.linspace(-LEAD, 0.0, WAY)[:, None, None]
    way = q + qd * before + 0.5 * qdd * before**2
    clear = clear_of_itself(model, way.reshape(-1, q.shape[1])).reshape(way.shape[:2]).all(axis=0)
    # an arm that is always near itself by its coarse shape is tried everywhere
    return np.flatnonzero(clear if clear.any() else ~clear)[:POSES]


def max_speed(model: Model) -> Array:
    """Return the speed limit of each joint (n,), rad/s."""
    limit = model.arm.limits.velocity
    return np.where(np.isfinite(limit) & (limit > 0), limit, DEFAULT_MAX_SPEED)


def _range(model: Model) -> tuple[Array, Array]:
    """Return the range of each joint (n,), (n,), rad: one turn at most, about zero if allowed."""
    # finite values for infinite limits
    low, high = (
        np.clip(side, -1e6, 1e6) for side in (model.arm.limits.lower, model.arm.limits.upper)
    )
    half = np.minimum(np.pi, (high - low) / 2)
    middle = np.clip(0.0, low + half, high - half)
    return middle - half, middle + half


def _positions(model: Model, trials: Trials) -> Predict:
    return lambda terms: model.with_terms(terms).predict(trials.q, trials.loads).position


def _loads_of_motion(
    predict: Callable[[Model, Motion, Sequence[Term]], Array], model: Model, trials: Trials
) -> Predict:
    motion = with_pieces(model, _motion(model, trials))
    return lambda terms: predict(model, motion, terms)


def _motion(model: Model, trials: Trials) -> Motion:
    return replace(
        Motion.at_rest(trials.q, trials.loads), t=np.full(len(trials.q), trials.time),
        qd=trials.qd, qdd=trials.qdd, start=trials.start, moving=bool(trials.qd.any()),
        still=STILL * max_speed(model),
    )  # fmt: skip


def _encoder_angles(model: Model, trials: Trials) -> Predict:
    """Return the predictor of the encoder angles at the end of each trial's motion."""
    count, n = trials.q.shape
    before = BEFORE.ravel()
    k = len(before)
    t = before[None, :, None]
    q = (trials.q[:, None] + trials.qd[:, None] * t + 0.5 * trials.qdd[:, None] * t**2).reshape(
        -1, n
    )
    speed = (trials.qd[:, None] + trials.qdd[:, None] * t).reshape(-1, n)
    offset = np.arange(count)[:, None] * 10.0 * LEAD  # trials in sequence
    trial = np.repeat(np.arange(count), k)
    motion = replace(
        Motion.at_rest(q, trials.loads[trial]), t=(trials.time + offset + before[None]).ravel(),
        qd=speed, qdd=trials.qdd[trial], target_q=q, stretch=trial, start=trials.start,
        moving=True, still=STILL * max_speed(model),
    )  # fmt: skip
    motion = with_holding_torque(model, motion)
    return lambda terms: predict_tracking(model, motion, terms)[k - 1 :: k]


PREDICTORS: dict[str, Callable[[Model, Trials], Predict]] = {
    "position": _positions,
    "wrench": partial(_loads_of_motion, predict_wrench),
    "tracking": _encoder_angles,
    "torque": partial(_loads_of_motion, predict_torque),
}
