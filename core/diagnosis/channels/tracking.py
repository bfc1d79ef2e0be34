"""The tracking channel: encoder angles against commanded angles."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.channels.recording import (
    conditions,
    held_torques,
    instrument_noise,
    joint_axes,
    own_joints,
    quantities,
    subsampled,
)
from gapbridge.core.diagnosis.observation import NotObservable, Observation, Predict
from gapbridge.core.dynamics import predict_tracking, with_holding_torque
from gapbridge.core.effects import Term
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion, motion_of
from gapbridge.core.sessions import session_of

MIN_TURN = 0.05  # rad, commanded range of a joint on whose angle the gap may depend
MIN_LEAD = 0.1  # s left out at the start of each stretch, where past commands are unknown
DECIMALS = 2e-7  # rad: smaller differences are rounding of the log
CACHED = 64  # predictions of one joint
LEAD_IN_DELAYS = 4.0  # times the delay: the time left out if that is longer


def observe(model: Model, log: Log, metrology: Metrology) -> Observation | NotObservable:
    """Return the tracking channel of a log (rad, one coordinate a joint), or what it lacks.

    Delays are predicted on every row; of more than 30,000 poses at rest 30,000 are compared. The
    start of each stretch is left out, because the commands before it are unknown. ``sigma`` is the
    encoder's step over the root of 12. Raises LogError if the log holds something unusable.
    """
    needs = tuple(name for name in ("target_q", "actual_q") if not log.has(name))
    if needs:
        return NotObservable("tracking", needs)
    motion = with_holding_torque(model, motion_of(log))
    return _observed(model, log, motion, subsampled(log, _known_past(motion), motion))


def _observed(model: Model, log: Log, motion: Motion, rows: Index) -> Observation:
    """Return the channel at some rows of the motion."""
    part = motion.pick(rows)
    n, target = model.arm.n, motion.target_q
    assert target is not None
    # of a joint that rests the reading is its encoder's noise, as its gap is: it would depend on it
    resting = [f"actual_q_{j}" for j in np.flatnonzero(np.ptp(target[rows], axis=0) < MIN_TURN)]
    known = held_torques(part) | quantities(log, part)
    return Observation(
        channel="tracking",
        unit="rad",
        measured=part.q,
        predict=_encoders_under(model, motion, rows),
        nuisance=np.zeros((len(part), n, 0)),
        weight=np.ones(n),
        sigma=encoder_step(log.require("actual_q")) / np.sqrt(12),
        sigma_is_whole=False,
        quantities={name: z for name, z in known.items() if name not in resting},
        groups=conditions(part),
        rows=part.rows,
        axes=joint_axes(n),
        joint_columns=own_joints(len(part), n),
        order_in_time=motion.moving,
        instrument=lambda: instrument_noise(motion.q - target, motion),
        subset=lambda take: _observed(model, log, motion, rows[take]),
        session=session_of(log)[part.rows] if log.session_names else None,
    )


def _encoders_under(model: Model, motion: Motion, rows: Index) -> Predict:
    """Return the predictor of the encoder angles of some rows under further terms.

    A fit changes one joint at a time: predictions of the others are cached.
    """
    plain: Array = predict_tracking(model, motion)[rows]

    @lru_cache(maxsize=CACHED)
    def joint_under(joint: int, own: tuple[Term, ...]) -> Array:
        return np.asarray(predict_tracking(model, motion, own)[rows, joint - 1])

    def predict(terms: Sequence[Term]) -> Array:
        if any(term.site.joint is None for term in terms):
            return np.asarray(predict_tracking(model, motion, terms)[rows])
        angles = plain.copy()
        for joint in {term.site.joint for term in terms if term.site.joint is not None}:
            own = tuple(term for term in terms if term.site.joint == joint)
            angles[:, joint - 1] = joint_under(joint, own)
        return angles

    return predict


def encoder_step(q: Array) -> float:
    """Return the quantisation step (rad) of encoder angles (N, n); 0: continuous."""
    steps = []
    for angles in q.T:
        gaps = np.diff(np.unique(angles))
        gaps = gaps[gaps > DECIMALS]
        if len(gaps) < 20:
            continue
        step = float(np.quantile(gaps, 0.05))
        few = gaps[gaps < 20.5 * step] / step
        whole = np.abs(few - np.round(few)) < 0.1
        if len(few) >= 10 and whole.mean() > 0.9:
            steps.append(step)
    return float(np.median(steps)) if steps else 0.0


def _known_past(motion: Motion) -> NDArray[np.bool_]:
    """Return the rows (N,) for which the preceding commands are in the log."""
    keep = np.ones(len(motion), dtype=bool)
    if not motion.moving:
        return keep
    assert motion.target_q is not None
    # the slope of the gap over the speed is the total delay of each joint
    behind = ((motion.target_q - motion.q) * motion.qd).sum(axis=0)
    speed = (motion.qd**2).sum(axis=0)
    delay = np.where(speed > 1e-6 * len(motion), behind / np.maximum(speed, 1e-12), 0.0)
    lead = max(MIN_LEAD, LEAD_IN_DELAYS * float(np.abs(delay).max()))
    begins = np.concatenate([[True], np.diff(motion.stretch) > 0])
    since = motion.t - np.maximum.accumulate(np.where(begins, motion.t, -np.inf))
    late = since >= min(lead, 0.25 * float(motion.t[-1] - motion.t[0]))
    return np.asarray(late) if late.any() else keep
