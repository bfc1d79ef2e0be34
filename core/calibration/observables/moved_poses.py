"""How the poses of a calibration's readings change with its parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.estimation.pose_jacobian import PoseColumns, pose_columns

Array = NDArray[np.float64]
SHARE = 0.01  # of a parameter's usual size, as the step of a difference


def moved_poses(parameters: Parameters, values: Array, readings: Readings) -> PoseColumns:
    """Return the TCP poses of the readings at ``values`` (p,), and their derivatives (6, p, N)."""
    model, chosen = parameters.model_with_all(values)
    return pose_columns(model, readings.q, readings.loads, chosen, SHARE * parameters.scales)
