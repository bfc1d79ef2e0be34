"""Compile the inner loops: ``python -m gapbridge.bridge.loop.warm_up``, once per installation.

Numba caches compiled code next to the sources. Without this, the first command of a new
installation compiles for half a minute.
"""

from __future__ import annotations

from multiprocessing import get_context

import numpy as np

from gapbridge.bridge.loop.setpoint_stream import NominalStream
from gapbridge.core.arm import arm_from_dh, builtin_arm, builtin_rows
from gapbridge.core.compensation import Compensator, correct
from gapbridge.core.dynamics import with_pieces
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.effects.effect import Effect, Term
from gapbridge.core.estimation.pose_jacobian import pose_columns
from gapbridge.core.kernels.factor import factor_blocks
from gapbridge.core.kernels.interpolation import lagged, played
from gapbridge.core.kernels.rates import of_rows
from gapbridge.core.limits import Limiter, Limits
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import motion_of
from gapbridge.drivers.gate import Gate
from gapbridge.drivers.offset_inverse import Nominal

N = 6
Q = np.array([[0.0, -1.5, 1.8, -1.87, -1.57, 0.0]])
FOUR = np.repeat(Q, 4, axis=0)


def warm_up() -> None:
    """Call each compiled function once: common ones first, then two halves on two cores."""
    model = _model()
    model.predict(Q).rotation_vector  # noqa: B018 (compiled when asked for)
    model.linear_form(Q)
    other = get_context("fork").Process(target=_setpoints)
    other.start()
    _logs()
    other.join()
    _setpoints()  # loads the other process's cache here; compiles if it failed


def _setpoints() -> None:
    """Call the kernels of the live loop, and of signals in time."""
    model = _model()
    corrected = Compensator(model).correct(Q[0])
    Gate(500.0, model, True, lambda: 0.0)
    Nominal(model)
    NominalStream(np.ones(N), -np.ones(N), np.ones(N))
    limits = Limits(np.full(N, -7.0), np.full(N, 7.0), np.full(N, 3.0))
    limiter = Limiter(limits, N)
    limiter.start(Q[0])
    limiter.limit(Q[0], corrected.q, corrected.offset_in_base, 1.0, Q[0], 0.002)
    looking = next(e for e in CATALOGUE.values() if type(e).condition is not Effect.condition)
    site = looking.sites(model.arm)[0]
    values = (0.0,) * len(looking.parameters(model.arm, site))
    of_angles = model.with_terms([Term(looking.identifier, site, values)])
    Compensator(of_angles).correct(Q[0])  # an effect that looks at the joint angles
    few = Model(arm_from_dh(builtin_rows("ur10e")["dh"][:5]))
    Compensator(few).missed(Q[0, :5], Loads(), 0.0)  # arms that cannot reach every pose
    time = np.array([0.0, 0.002, 0.004, 0.006])
    lagged(time, time, 0.1, 0.0)
    played(time, 0.1, 0.0)


def _logs() -> None:
    """Call the kernels for logs: blocks of rows, their Jacobians, rigid dynamics."""
    model = _model()
    model.predict(FOUR).rotation_vector  # noqa: B018 (compiled when asked for)
    model.linear_form(FOUR)
    pose_columns(model, FOUR, None, [(0, 0)], np.array([1e-9]))
    gap, factor = np.zeros((1, 3)), np.zeros((2 * N + 1, 2 * N + 1))
    factor_blocks(model.chain(), model.rows(Q), gap, gap, 0, 1, factor)
    of_rows(N)
    with_pieces(model, motion_of(Log("", {"actual_q": Q}, N)))
    correct(model, np.vstack([Q, 0.0 * Q]))  # a singularity, too, which the blocks leave


def _model() -> Model:
    return Model(builtin_arm("ur10e")).with_compliance([1e-6] * N, [1e-6] * N)


if __name__ == "__main__":
    warm_up()
