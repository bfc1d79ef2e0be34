"""Pose accuracy and pose repeatability from repeated visits (ISO 9283:1998, 7.2.1 and 7.2.2).

For n visits of one pose, with l_j the distance of the j-th attained position from their barycentre:
AP_P is the distance of the barycentre from the commanded position, AP_x, AP_y, AP_z its components,
RP_l = mean(l) + 3 S_l with S_l the standard deviation of the l_j (n - 1). For each angle a, AP_a is
the mean's difference from the commanded one, RP_a is 3 S_a.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Index
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.result import Calibration, Errors
from gapbridge.core.rotation import rotation_matrix, rotation_vector

KINDS = ("position", "pose")  # of readings that are positions of the TCP
SAME_COMMAND = 2e-4  # rad: repeats whose encoders differ by more had different commands


@dataclass(frozen=True)
class PoseAccuracy:
    """AP and RP of one pose under one load."""

    pose: int
    load: int
    visits: int
    before: Array  # (3,) m, base: AP_x, AP_y, AP_z against the nominal model
    after: Array  # (3,) the same against the calibrated one
    mean_distance: float  # m, of the visits from their barycentre
    deviation: float  # m, S_l
    turn: Array | None  # (3,) rad, AP_a, AP_b, AP_c after, about the base's axes; None: unmeasured
    angles: Array | None  # (3,) rad, RP_a, RP_b, RP_c about the base's axes; None: unmeasured
    steered: bool  # True: encoders differed, and the predicted difference was subtracted

    @property
    def accuracy(self) -> tuple[float, float]:
        """Return AP_P before and after, m."""
        return float(np.linalg.norm(self.before)), float(np.linalg.norm(self.after))

    @property
    def repeatability(self) -> float:
        """Return RP_l, m; nan for a single visit."""
        return self.mean_distance + 3 * self.deviation


def pose_accuracies(calibration: Calibration) -> tuple[PoseAccuracy, ...]:
    """Return AP and RP of every pose with two or more visits from the same side.

    None for readings that are not positions of the TCP.
    """
    readings = calibration.readings
    if readings.kind not in KINDS:
        return ()
    before = _by_reading(len(readings), calibration.before, calibration.held_out_before)
    after = _by_reading(len(readings), calibration.after, calibration.held_out_after)
    known = np.isfinite(before[:, 0])
    known[calibration.outliers] = False
    return tuple(
        _accuracy(calibration, rows, before[rows], after[rows]) for rows in repeats(readings, known)
    )


def repeats(readings: Readings, known: NDArray[np.bool_] | None = None) -> list[Index]:
    """Return the rows of each pose that was visited at least twice.

    Same pose, load, place of the instrument, target and direction of approach.
    """
    keys = [readings.pose, readings.load, readings.station, readings.target]
    if readings.loads.approach is not None:
        keys += list(np.sign(readings.loads.approach).T.astype(np.int64))
    table = np.column_stack(keys)
    rows = np.arange(len(readings)) if known is None else np.flatnonzero(known)
    _, group = np.unique(table[rows], axis=0, return_inverse=True)
    found = [rows[group.ravel() == k] for k in range(group.max(initial=-1) + 1)]
    return [rows for rows in found if len(rows) > 1]


def _by_reading(count: int, *parts: Errors) -> Array:
    vector = np.full((count, 3), np.nan)
    for part in parts:
        if len(part.vector):
            vector[part.rows] = part.vector[:, :3]
    return vector


def _accuracy(calibration: Calibration, rows: Index, before: Array, after: Array) -> PoseAccuracy:
    readings = calibration.readings[rows]
    frame = calibration.stations[int(readings.station[0])]
    attained = frame.in_base(readings.value[:, :3])
    steered = bool(np.ptp(readings.q, axis=0).max() > SAME_COMMAND)
    predicted = calibration.model.predict(readings.q, readings.loads)
    if steered:
        attained = attained - (predicted.position - predicted.position.mean(axis=0))
    distance = np.linalg.norm(attained - attained.mean(axis=0), axis=1)
    turn = angles = None
    if readings.kind == "pose":
        rotation = frame.rotation_in_base(rotation_matrix(readings.value[:, 3:]))
        # small angles add up like a vector, so that no order of rotations has to be chosen
        turns = rotation_vector(rotation @ np.swapaxes(predicted.rotation, 1, 2))
        turn, angles = turns.mean(axis=0), 3 * turns.std(axis=0, ddof=1)
    return PoseAccuracy(
        int(readings.pose[0]), int(readings.load[0]), len(rows), before.mean(axis=0),
        after.mean(axis=0), float(distance.mean()), float(distance.std(ddof=1)), turn, angles,
        steered,
    )  # fmt: skip
