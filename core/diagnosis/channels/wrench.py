"""The wrench channel: the flange sensor against the wrench of payload and external force."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.derivatives import signal_noise
from gapbridge.core.diagnosis.channels.recording import (
    CONSTANT_SPREAD,
    conditions,
    instrument_noise,
    living,
    quantities,
    subsampled,
    without_dead,
)
from gapbridge.core.diagnosis.observation import NotObservable, Observation
from gapbridge.core.diagnosis.selection.unnamed import unnamed_loads
from gapbridge.core.dynamics import predict_wrench, with_pieces
from gapbridge.core.effects import Term
from gapbridge.core.effects.effect import WRENCH_AXES
from gapbridge.core.estimation.robust import scale_of
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion, motion_of
from gapbridge.core.sessions import session_of

USUAL_WEIGHT = 10.0  # N/Nm of torques relative to forces, without a noise to measure it
WEIGHTS = (1.0, 1000.0)  # N/Nm, plausible range


def observe(model: Model, log: Log, metrology: Metrology) -> Observation | NotObservable:
    """Return the wrench channel of a log (N), or what it lacks.

    Torques are weighted by the ratio of the noise of forces to that of torques. Rows without
    derivatives and rows whose wrench is not finite are left out. Of more than 30,000 poses at rest
    30,000 are taken. Not observable if the sensor, or an axis of it, is dead (``without_dead``); a
    session in which one is is left out. Raises LogError if the log holds something unusable.
    """
    measured = log.get("ft_raw_wrench")
    needs = [] if measured is not None else ["ft_raw_wrench"]
    joints = log.get("actual_q", "target_q")
    if joints is None:
        needs.append("actual_q")
    if measured is None or joints is None:
        return NotObservable("wrench", tuple(needs))
    whole = motion_of(log)
    measured, dead = without_dead(
        log, measured, whole, 3, lambda part: predict_wrench(model, with_pieces(model, part))
    )
    rows = subsampled(log, whole.valid & np.isfinite(measured[whole.rows]).all(axis=1), whole)
    if not len(rows):
        return NotObservable("wrench", living("ft_raw_wrench", dead))
    return _observed(model, log, measured, whole, rows)


def _observed(
    model: Model, log: Log, measured: Array, whole: Motion, rows: NDArray[np.int64]
) -> Observation:
    """Return the channel at some rows of the motion."""
    motion = with_pieces(model, whole.pick(rows))
    value = measured[motion.rows]

    def predict(terms: Sequence[Term]) -> Array:
        return predict_wrench(model, motion, terms)

    expected = predict(())
    noise = _noise(measured[whole.rows], whole, value, expected, motion)
    return Observation(
        channel="wrench",
        unit="N",
        measured=value,
        predict=predict,
        nuisance=np.zeros((len(motion), 6, 0)),
        weight=np.repeat([1.0, torque_weight(noise, value)], 3),
        sigma=0.0,
        sigma_is_whole=False,
        quantities=quantities(log, motion) | _readings(expected),
        groups=conditions(motion),
        rows=motion.rows,
        axes=WRENCH_AXES,
        payload_mass=motion.loads.payload_mass,
        order_in_time=motion.moving,
        unnamed=lambda: unnamed_loads(model, motion, "wrench"),
        instrument=lambda: instrument_noise(measured[whole.rows], whole),
        subset=lambda take: _observed(model, log, measured, whole, rows[take]),
        session=session_of(log)[motion.rows] if log.session_names else None,
    )


def _readings(wrench: Array) -> dict[str, Array]:
    """Return the expected wrench (N, 6) as quantities: sensor errors depend on the load."""
    spread = np.ptp(wrench, axis=0)
    return {f"ft_raw_wrench_{i}": wrench[:, i] for i in np.flatnonzero(spread > CONSTANT_SPREAD)}


def torque_weight(noise: Array, wrench: Array) -> float:
    """Return the weight (N/Nm) of torques relative to forces, by their ``noise`` (6,)."""
    force, torque = (float(np.sqrt(np.mean(noise[k] ** 2))) for k in (slice(3), slice(3, 6)))
    tiny = 1e-7 * max(float(np.abs(wrench).max()), 1e-3)
    if not (force > tiny and torque > 1e-2 * tiny):
        return USUAL_WEIGHT  # no noise to speak of
    return float(np.clip(force / torque, *WEIGHTS))


def _noise(sensor: Array, whole: Motion, value: Array, predicted: Array, motion: Motion) -> Array:
    """Return the noise of each axis (6,): white noise in motion, else that of a flexible fit."""
    if whole.moving:
        kept = sensor[np.isfinite(sensor).all(axis=1)]
        return signal_noise(kept)
    assert motion.pieces is not None
    time = (motion.t - motion.t[0]) / max(float(np.ptp(motion.t)), 1.0)
    design = [np.ones((len(motion), 1)), time[:, None], predicted, motion.pieces.payload_wrench]
    while design:
        design_matrix = np.column_stack(design)
        degrees_of_freedom = len(motion) - np.linalg.matrix_rank(design_matrix)
        if degrees_of_freedom >= max(5, len(motion) // 4):
            remainder = value - design_matrix @ np.linalg.lstsq(design_matrix, value, rcond=None)[0]
            typical = np.array([scale_of(axis) for axis in remainder.T])
            return np.asarray(typical * np.sqrt(len(motion) / degrees_of_freedom))
        design.pop()
    return np.zeros(6)
