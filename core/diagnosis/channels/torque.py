"""The torque channel: measured joint torques against the rigid arm's inverse dynamics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.channels.recording import (
    conditions,
    instrument_noise,
    joint_axes,
    living,
    own_joints,
    quantities,
    subsampled,
    without_dead,
)
from gapbridge.core.diagnosis.observation import NotObservable, Observation
from gapbridge.core.diagnosis.selection.unnamed import unnamed_loads
from gapbridge.core.dynamics import predict_torque, with_pieces
from gapbridge.core.effects import Term
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion, motion_of
from gapbridge.core.predicted_channels import NO_MASSES
from gapbridge.core.sessions import session_of

MIN_MOVING_SHARE = 0.4  # of the rows in which all joints move, for rows at rest to be left out
MAX_REVERSAL = 0.15  # s: a joint that is slow for longer is at rest, not reversing


def observe(model: Model, log: Log, metrology: Metrology) -> Observation | NotObservable:
    """Return the torque channel of a log (Nm, one coordinate a joint), or what it lacks.

    Rows without derivatives (edges, gaps), with a torque that is not finite, or with a joint that
    reverses (unknown sign of friction) are left out. Of more than 30,000 poses at rest 30,000 are
    taken. Not observable if the links have no mass or a torque that should change is constant; a
    session in which one is (``without_dead``) is left out.
    Raises LogError if the log holds something unusable.
    """
    measured = log.get("actual_current_as_torque")
    needs = _needed(model, log)
    if measured is None or needs:
        return NotObservable("torque", needs)
    whole = motion_of(log)
    measured, dead = without_dead(
        log,
        measured,
        whole,
        model.arm.n,
        lambda part: predict_torque(model, with_pieces(model, part)),
    )
    finite = np.isfinite(measured[whole.rows]).all(axis=1)
    rows = subsampled(log, whole.valid & finite & _steady(whole), whole)
    if not len(rows):
        return NotObservable("torque", living("actual_current_as_torque", dead))
    return _observed(model, log, measured, whole, rows)


def _observed(
    model: Model, log: Log, measured: Array, whole: Motion, rows: NDArray[np.int64]
) -> Observation:
    """Return the channel at some rows of the motion."""
    motion = with_pieces(model, whole.pick(rows))

    def predict(terms: Sequence[Term]) -> Array:
        return predict_torque(model, motion, terms)

    n = model.arm.n
    return Observation(
        channel="torque",
        unit="Nm",
        measured=measured[motion.rows],
        predict=predict,
        nuisance=np.zeros((len(motion), n, 0)),
        weight=np.ones(n),
        sigma=0.0,
        sigma_is_whole=False,
        quantities=quantities(log, motion),
        groups=conditions(motion),
        rows=motion.rows,
        axes=joint_axes(n),
        joint_columns=own_joints(len(motion), n),
        payload_mass=motion.loads.payload_mass,
        order_in_time=motion.moving,
        friction=motion.direction if motion.moving else None,
        unnamed=lambda: unnamed_loads(model, motion, "torque"),
        instrument=lambda: instrument_noise(measured[whole.rows], whole),
        subset=lambda take: _observed(model, log, measured, whole, rows[take]),
        session=session_of(log)[motion.rows] if log.session_names else None,
    )


def _needed(model: Model, log: Log) -> tuple[str, ...]:
    needs = [] if log.has("actual_current_as_torque") else ["actual_current_as_torque"]
    if not (log.has("actual_q") or log.has("target_q")):
        needs.append("actual_q")
    if not model.arm.mass.any():
        needs.append(NO_MASSES)
    return tuple(needs)


def _steady(motion: Motion) -> NDArray[np.bool_]:
    """Return the rows (N,) in which every joint's friction has a known sign, as far as possible.

    Joints that never move count as known (no friction). If joints move one at a time, so that some
    joint is at rest in most rows, only the reversals are left out.
    """
    keep = np.ones(len(motion), dtype=bool)
    if not motion.moving:
        return keep
    slow = motion.turning
    if np.mean(~slow.any(axis=1)) >= MIN_MOVING_SHARE:
        return np.asarray(~slow.any(axis=1))
    for j in range(slow.shape[1]):
        for first, last in _runs(slow[:, j]):
            if motion.t[last] - motion.t[first] < MAX_REVERSAL:
                keep[first : last + 1] = False
    return keep


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first and last index of each run of True."""
    edges = np.diff(np.concatenate([[0], flags.astype(int), [0]]))
    first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return [(int(a), int(b)) for a, b in zip(first, last, strict=True)]
