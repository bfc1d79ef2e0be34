"""What a model predicts of each channel of a log, row by row, whether it was measured or not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.dynamics import predict_torque, predict_tracking, predict_wrench, with_pieces
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion, motion_of

Array = NDArray[np.float64]
NO_MASSES = "masses of the links (in the cell's robot)"


def predicted_channels(model: Model, log: Log) -> tuple[dict[str, Array], dict[str, str]]:
    """Return the predicted columns (N, k) by name, and for each channel without, what it needs.

    ``predicted_torque`` (Nm, joints: ``actual_current_as_torque``), ``predicted_wrench`` (N and Nm,
    flange axes: ``ft_raw_wrench``), ``predicted_q`` (rad: ``actual_q`` under the log's
    ``target_q``). Rows without derivatives (edges and gaps of a recording) are nan in torque and
    wrench. Raises LogError where the log holds something unusable.
    """
    motion = motion_of(log)
    found: dict[str, Array] = {}
    lacking: dict[str, str] = {}
    whole = with_pieces(model, motion)
    if model.arm.mass.any():
        found["predicted_torque"] = _spread(predict_torque, model, whole, len(log), whole.valid)
    else:
        lacking["torque"] = NO_MASSES
    found["predicted_wrench"] = _spread(predict_wrench, model, whole, len(log), whole.valid)
    if motion.target_q is None:
        lacking["tracking"] = "target_q"
    else:
        every = np.ones(len(motion), dtype=bool)
        found["predicted_q"] = _spread(predict_tracking, model, motion, len(log), every)
    return found, lacking


def _spread(
    predict: Callable[[Model, Motion], Array], model: Model, motion: Motion, count: int,
    valid: NDArray[np.bool_],
) -> Array:  # fmt: skip
    """Return a prediction at the rows of the log (N, k), nan where there is none."""
    value = predict(model, motion)
    out = np.full((count, value.shape[1]), np.nan)
    out[motion.rows[valid]] = value[valid]
    return out
