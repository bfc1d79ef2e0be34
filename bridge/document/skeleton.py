"""The arm as a line through its joints, rigid or deflected, for drawings."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.kernels import reference as kernel
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model


def skeleton(model: Model, q: Array, loads: Loads | None = None) -> Array:
    """Return base, joint origins, flange and TCP (n + 3, 3), m in base, at ``q`` (n,) rad.

    ``loads``: of one row; None: the model's payload only.
    """
    shape = kernel.new_shape(model.arm.n)
    rows = model.rows(np.asarray(q, dtype=np.float64)[None], loads or Loads())
    kernel.equilibrium(model.chain(), rows, 0, shape)
    return np.vstack([np.zeros(3), shape.origin, shape.tcp_position])


def reach(model: Model) -> float:
    """Return the length of the stretched arm, m, without its tool."""
    return max(model.arm.length, 0.1)


def round_factor(wanted: float) -> float:
    """Return the next lower number of one digit, at least 1: a magnification for drawings."""
    size = 10 ** np.floor(np.log10(max(wanted, 1.0)))
    return float(max(np.floor(wanted / size) * size, 1.0))
