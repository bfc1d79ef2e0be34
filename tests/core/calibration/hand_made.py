"""Calibrations with errors made by hand: nothing is fitted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import builtin_arm
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.result import Calibration, Errors, Estimate
from gapbridge.core.estimation.registration import IDENTITY, Registration
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason

Array = NDArray[np.float64]


def hand_made(
    error: Array, *, pose: list[int] | None = None, held_out: list[bool] | None = None,
    q: Array | None = None, before: Array | None = None, kind: str = "position",
    frame: Registration = IDENTITY, turn: Array | None = None, approach: Array | None = None,
    estimates: tuple[Estimate, ...] = (), covariance: Array | None = None, **given: object,
) -> Calibration:  # fmt: skip
    """Return a calibration of a UR10e whose readings miss its model by ``error`` (N, 3), m."""
    model = Model(builtin_arm("ur10e"))
    count = len(error)
    zeros = np.zeros(count, dtype=np.int64)
    q = np.tile([0.3, -1.2, 1.4, -1.0, -1.5, 0.4], (count, 1)) if q is None else q
    value = (model.predict(q).position + error) @ frame.rotation.T + frame.position
    if turn is not None:
        value = np.hstack([value, turn])
    held = np.array(held_out or [False] * count)
    readings = Readings(
        kind, q, value, np.full(count, np.nan), Loads(approach=approach), zeros, zeros, zeros,
        held, np.array(pose if pose is not None else range(count)),
    )  # fmt: skip
    before = error if before is None else before

    def part(vector: Array, rows: NDArray[np.bool_]) -> Errors:
        return Errors(vector[rows], np.flatnonzero(rows))

    reported: dict[str, object] = {
        "noise": 2e-5, "repeatability": 1e-5, "tcp_std": np.full(held.sum(), 3e-5),
        "instrument_noise": 1e-5, "freedom": 60.0,
    } | given  # fmt: skip
    return Calibration(
        model=model, readings=readings, estimates=estimates,
        covariance=np.zeros((0, 0)) if covariance is None else covariance, combinations=(),
        before=part(before, ~held), after=part(error, ~held), held_out_before=part(before, held),
        held_out_after=part(error, held), outliers=np.zeros(0, dtype=np.int64), stations=(frame,),
        diagnosis=None, complete=True, remaining=Note(Reason.NOTHING), **reported,  # type: ignore[arg-type]
    )  # fmt: skip
