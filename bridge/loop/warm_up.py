"""Compile the inner loops: ``python -m gapbridge.bridge.loop.warm_up``, once per installation.

Numba keeps what it has compiled beside the sources. Without this, the first command of a new
installation spends half a minute on it, in the middle of its work.
"""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.loop.setpoint_stream import NominalStream
from gapbridge.core.arm import builtin_arm
from gapbridge.core.compensation import Compensator, correct
from gapbridge.core.dynamics import with_pieces
from gapbridge.core.estimation.pose_jacobian import pose_columns
from gapbridge.core.kernels.factor import factor_blocks
from gapbridge.core.limits import Limiter, Limits
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import motion_of
from gapbridge.drivers.offset_inverse import Nominal


def warm_up() -> None:
    """Call each compiled function once."""
    n = 6
    model = Model(builtin_arm("ur10e")).with_compliance([1e-6] * n, [1e-6] * n)
    q = np.array([[0.0, -1.5, 1.8, -1.87, -1.57, 0.0]])
    for rows in (q, np.repeat(q, 4, axis=0)):  # one by one, and in blocks
        model.predict(rows).rotation_vector  # noqa: B018 (compiled when asked for)
        model.linear_form(rows)
    with_pieces(model, motion_of(Log("", {"actual_q": q}, n)))
    pose_columns(model, q, None, [(0, 0)], np.array([1e-9]))
    gap, factor = np.zeros((1, 3)), np.zeros((2 * n + 1, 2 * n + 1))
    factor_blocks(model.chain(), model.rows(q), gap, gap, 0, 0, 1, factor)
    corrected = correct(model, q)  # many rows, and one in the loop
    Compensator(model).correct(q[0])
    Nominal(model)
    NominalStream(np.ones(n))
    limits = Limits(np.full(n, -7.0), np.full(n, 7.0), np.full(n, 3.0))
    limiter = Limiter(limits, n)
    limiter.start(q[0])
    limiter.limit(q[0], corrected.q[0], corrected.offset_in_base[0], 1.0, q[0], 0.002)


if __name__ == "__main__":
    warm_up()
