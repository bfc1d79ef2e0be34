"""Many rows, by the quickest loop that can: blocks of lanes, or one row after the other."""

from __future__ import annotations

import numpy as np
from numba import config, njit

from gapbridge.core.arrays import Array
from gapbridge.core.kernels import reference as kernel
from gapbridge.core.kernels.factor import flexibility_columns
from gapbridge.core.kernels.lanes import bends, gather, keep_pose, lanes_of, settle
from gapbridge.core.kernels.layout import AXIS, LANES, MOMENT, ORIGIN, RECORD, TCP
from gapbridge.core.kernels.reference import INNER, JIT, Chain, Rows
from gapbridge.core.kernels.threads import in_ranges

FEW = 2  # rows that are not worth a block


def _part(rows: Rows, first: int, last: int) -> Rows:
    return Rows(*(part[first:last] for part in rows))


def _singly(chain: Chain, rows: Rows) -> bool:
    """Return whether blocks cannot (links that bend), or would take longer (not compiled)."""
    return (
        len(rows.q) <= FEW
        or bool(chain.flexibility.any())
        or bool(getattr(config, "DISABLE_JIT", 0))
    )


def predict(chain: Chain, rows: Rows, position: Array, rotation: Array) -> int:
    """Write the TCP pose of every row; returns the first row without equilibrium, or -1."""
    if _singly(chain, rows):
        return int(kernel.predict_rows(chain, rows, position, rotation))

    def work(first: int, last: int) -> int:
        return int(predict_blocks(chain, rows, first, last, position, rotation))

    return next((bad for bad in in_ranges(work, len(rows.q)) if bad >= 0), -1)


def linear_form(chain: Chain, rows: Rows, A: Array, jacobian: Array, moment: Array) -> int:
    """Write the linear form of every row (``kernel.regressor_rows``); returns as ``predict``."""

    def singly(first: int, last: int) -> int:
        found = kernel.regressor_rows(
            chain, _part(rows, first, last), A[first:last], jacobian[first:last],
            moment[first:last],
        )  # fmt: skip
        return first + int(found) if found >= 0 else -1

    def work(first: int, last: int) -> int:
        stopped = int(linear_blocks(chain, rows, first, last, A, jacobian, moment))
        return -1 if stopped < 0 else singly(stopped, last)

    if _singly(chain, rows):
        return singly(0, len(rows.q))
    return next((bad for bad in in_ranges(work, len(rows.q)) if bad >= 0), -1)


@njit(**JIT)
def predict_blocks(chain, rows, first, last, position, rotation):  # type: ignore[no-untyped-def]
    """Write the TCP poses of rows first..last; returns the first without equilibrium, or -1.

    The arm's links must not bend themselves. A block that does not settle at once goes through
    core.kernels.reference, which says which of its rows it is.
    """
    n = chain.mass.shape[0]
    w, v = lanes_of(n)
    deflected, bad = bends(chain), -1
    for r in range(first, last, LANES):
        end = min(r + LANES, last)
        if not (gather(chain, rows, r, w, v) and settle(chain, w, v, deflected, False)):
            found = kernel.predict_range(chain, rows, r, end, position, rotation)
            bad = found if bad < 0 else bad
            continue
        for k in range(end - r):
            keep_pose(v, k, position[r + k], rotation[r + k])
    return bad


@njit(**JIT)
def linear_blocks(chain, rows, first, last, A, jacobians, moments):  # type: ignore[no-untyped-def]
    """Write the regressors as ``kernel.regressor_rows``, for rows first..last with rigid links.

    Returns -1, or the first row of a block that does not settle at once: reference.py's from there.
    """
    n = chain.mass.shape[0]
    w, v = lanes_of(n)
    X = np.empty(2 * n * 6 * LANES)
    deflected = bends(chain)
    for r in range(first, last, LANES):
        if not (gather(chain, rows, r, w, v) and settle(chain, w, v, deflected, False)):
            return r
        flexibility_columns(w, v, X, 0, n, 6)
        for k in range(min(LANES, last - r)):
            for j in range(6):
                for c in range(2 * n):
                    A[r + k, j, c] = X[(6 * c + j) * LANES + k]
            _written(w, v, k, jacobians[r + k], moments[r + k])
    return -1


@njit(**INNER)
def _written(w, v, k, J, moment):  # type: ignore[no-untyped-def]
    """Write the Jacobian (6, n) and the joint moments (n, 3) of lane k."""
    for i in range(moment.shape[0]):
        a = (i + 1) * RECORD * LANES + k
        for j in range(3):
            e, f = (j + 1) % 3, (j + 2) % 3
            lever_e = v[(TCP + e) * LANES + k] - w[a + (ORIGIN + e) * LANES]
            lever_f = v[(TCP + f) * LANES + k] - w[a + (ORIGIN + f) * LANES]
            J[j, i] = w[a + (AXIS + e) * LANES] * lever_f - w[a + (AXIS + f) * LANES] * lever_e
            J[3 + j, i] = w[a + (AXIS + j) * LANES]
            moment[i, j] = w[a + (MOMENT + j) * LANES]
