"""Suspicions: mistakes of units, frames and signs, told by name before anything is fitted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.errors import LogError
from core.log import Log
from core.model import Model

Array = NDArray[np.float64]
TURNS = 25.0  # rad: joints do not turn further; degrees do
REACHES = 50.0  # times the arm's reach from the middle: no arm gets there; millimetres do


def check_units(model: Model, log: Log) -> None:
    """Raise LogError where joints look like degrees, or positions like millimetres.

    An endless angle is no degrees: it is told as such, with its row.
    """
    for name in ("actual_q", "target_q"):
        q = log.get(name)
        if q is not None and np.isinf(q).any():
            log.require(name)
        if q is not None and np.isfinite(q).any() and np.nanmax(np.abs(q)) > TURNS:
            worst = float(np.nanmax(np.abs(q)))
            raise LogError(
                f"{log.path}: columns {name}_*: found values up to {worst:g}; the joint angles "
                "look like degrees, expected rad"
            )
    measured = log.get("measured_position")
    if measured is None:
        return
    spread = measured - np.nanmedian(measured, axis=0)
    size = float(np.nanmedian(np.linalg.norm(spread, axis=1)))
    reach = float(np.linalg.norm(model.arm.link_in_link[:, :3, 3], axis=1).sum())
    reach += float(np.linalg.norm(model.tool_in_flange[:3, 3]))
    if size > REACHES * max(reach, 0.05):
        raise LogError(
            f"{log.path}: columns measured_position_*: found positions {size:g} apart for an arm "
            f"of {reach:.2f} m reach; the positions look like millimetres, expected m"
        )


def findings(log: Log) -> list[str]:
    """Return what is odd about a log but does not forbid work."""
    told = []
    t = log.get("timestamp")
    if t is not None and len(t) > 1:
        repeated, back = int(np.sum(np.diff(t) == 0)), int(np.sum(np.diff(t) < 0))
        if repeated:
            told.append(f"{repeated} timestamp(s) are repeated")
        if back:
            told.append(f"{back} timestamp(s) run backwards: rows should be in time order")
    measured = log.get("measured_position")
    if measured is not None:
        gone = int(np.sum(~np.isfinite(measured).all(axis=1)))
        if gone:
            told.append(f"{gone} row(s) have no measured position and were left out")
        if len(measured) > 3 and float(np.nanmax(np.ptp(measured, axis=0))) < 1e-3:
            told.append("the measured positions hardly move: is it the right column?")
    return told
