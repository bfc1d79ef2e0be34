"""Trials: what could be measured next, and what each explanation predicts there.

Poses and loads within the arm's limits, at rest for the channels that show at rest; for the moving
ones each trial is a short motion through its pose, at a speed and an acceleration that the arm can.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.dynamics import (
    predict_torque,
    predict_tracking,
    predict_wrench,
    with_held,
    with_pieces,
)
from gapbridge.core.effects import Term
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion

Predict = Callable[[Sequence[Term]], Array]
POSES = 160
FAST = 0.7  # share of a joint's greatest speed that a trial uses at most
PICK_UP = 0.25  # s in which a trial gets to its speed, at the hardest
UNLIMITED = 2.0  # rad/s for joints whose greatest speed nobody knows
LEAD, STEP = 0.5, 0.004  # s: how a trial's motion is sampled before its pose
STILL = 0.02  # share of the greatest speed at which the direction of motion is unsure


@dataclass(frozen=True)
class Trials:
    """Poses, loads and motions that could be measured."""

    q: Array  # (N, n)
    loads: Loads
    qd: Array  # (N, n) rad/s through the pose, where the channel is one of motion
    qdd: Array  # (N, n) rad/s2 there
    time: float  # s, of the measurement
    start: float  # s, of the log

    @property
    def at_rest(self) -> Trials:
        """Return the same poses and loads without motion."""
        nothing = np.zeros_like(self.q)
        return replace(self, qd=nothing, qdd=nothing)


def draw_trials(model: Model, log: Log, seed: int) -> Trials:
    """Return trials within the joint limits and the rated load, drawn from ``seed``."""
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
    fastest = fastest_of(model)
    qd = FAST * fastest * rng.uniform(-1.0, 1.0, q.shape)
    # braking or picking up: never so hard that the trial began beyond the joint's greatest speed
    qdd = np.clip(
        rng.uniform(-1.0, 1.0, q.shape) * fastest / PICK_UP,
        (qd - fastest) / LEAD, (qd + fastest) / LEAD,
    )  # fmt: skip
    return Trials(q, loads, qd, qdd, end, start)


def fastest_of(model: Model) -> Array:
    """Return the greatest speed of each joint (n,), rad/s."""
    limit = model.arm.limits.velocity
    return np.where(np.isfinite(limit) & (limit > 0), limit, UNLIMITED)


def _range(model: Model) -> tuple[Array, Array]:
    """Return where each joint may stand (n,), (n,): one turn at most, about zero if it may."""
    # numbers so large that nothing is lost stand for "no limit": their sum is still a number
    low, high = (
        np.clip(side, -1e6, 1e6) for side in (model.arm.limits.lower, model.arm.limits.upper)
    )
    half = np.minimum(np.pi, (high - low) / 2)
    middle = np.clip(0.0, low + half, high - half)
    return middle - half, middle + half


def _positions(model: Model, trials: Trials) -> Predict:
    return lambda terms: model.with_terms(terms).predict(trials.q, trials.loads).position


def _wrenches(model: Model, trials: Trials) -> Predict:
    motion = with_pieces(model, _motion(model, trials))
    return lambda terms: predict_wrench(model, motion, terms)


def _torques(model: Model, trials: Trials) -> Predict:
    motion = with_pieces(model, _motion(model, trials))
    return lambda terms: predict_torque(model, motion, terms)


def _motion(model: Model, trials: Trials) -> Motion:
    count = len(trials.q)
    return Motion(
        t=np.full(count, trials.time), q=trials.q, qd=trials.qd, qdd=trials.qdd, target_q=None,
        loads=trials.loads, rows=np.arange(count), valid=np.ones(count, dtype=bool),
        stretch=np.zeros(count, dtype=np.int64), start=trials.start,
        moving=bool(trials.qd.any()),
        still=STILL * fastest_of(model),
    )  # fmt: skip


def _followings(model: Model, trials: Trials) -> Predict:
    """Return where the encoders stand at the end of each trial's motion."""
    count, n = trials.q.shape
    before = np.arange(-round(LEAD / STEP), 1) * STEP
    k = len(before)
    t = before[None, :, None]
    q = (trials.q[:, None] + trials.qd[:, None] * t + 0.5 * trials.qdd[:, None] * t**2).reshape(
        -1, n
    )
    speed = (trials.qd[:, None] + trials.qdd[:, None] * t).reshape(-1, n)
    hours = np.arange(count)[:, None] * 10.0 * LEAD  # one after the other
    motion = Motion(
        t=(trials.time + hours + before[None]).ravel(), q=q, qd=speed,
        qdd=np.repeat(trials.qdd, k, axis=0), target_q=q,
        loads=trials.loads[np.repeat(np.arange(count), k)],
        rows=np.arange(count * k), valid=np.ones(count * k, dtype=bool),
        stretch=np.repeat(np.arange(count), k), start=trials.start, moving=True,
        still=STILL * fastest_of(model),
    )  # fmt: skip
    motion = with_held(model, motion)
    return lambda terms: predict_tracking(model, motion, terms)[k - 1 :: k]


PREDICTED: dict[str, Callable[[Model, Trials], Predict]] = {
    "position": _positions,
    "wrench": _wrenches,
    "tracking": _followings,
    "torque": _torques,
}
