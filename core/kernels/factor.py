"""The R factor of many rows' regressor, in blocks of lanes, without ever storing it."""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.lanes import bends, gather, lanes_of, settle
from gapbridge.core.kernels.layout import (
    FAST,
    LANES,
    MOMENT,
    ORIGIN,
    RECORD,
    ROTATION,
    TCP,
    TCP_ROTATION,
    U,
)
from gapbridge.core.kernels.reference import JIT
from gapbridge.core.kernels.sums import fold

NUISANCES = 9  # instrument's frame (6), tool point (3)


@njit(**FAST)
def flexibility_columns(w, v, X, first, n, width):  # type: ignore[no-untyped-def]
    """Write d pose / d flexibility of the lanes: axial columns, then radial ones, from ``first``.

    X holds column after column, each ``width`` (3: position, 6: rotation besides) times LANES.
    """
    size = width * LANES
    for i in range(n):
        b, e, f = (i + 1) * RECORD * LANES, (first + i) * size, (first + n + i) * size
        _shift_columns(w, v, X, b, e, f)
        if width == 6:
            _turning_columns(w, X, e, f, b)


@njit(**FAST)
def _shift_columns(w, v, X, b, e, f):  # type: ignore[no-untyped-def]
    """Write the position rows of a joint's two columns, which begin at ``e`` and ``f``.

    A function of its own: in a loop over joints the compiler makes no vector instructions of it.
    """
    for k in range(LANES):
        zx = w[U(b + (ROTATION + 2) * LANES + k)]
        zy = w[U(b + (ROTATION + 5) * LANES + k)]
        zz = w[U(b + (ROTATION + 8) * LANES + k)]
        mx = w[U(b + MOMENT * LANES + k)]
        my = w[U(b + (MOMENT + 1) * LANES + k)]
        mz = w[U(b + (MOMENT + 2) * LANES + k)]
        dx = v[U(TCP * LANES + k)] - w[U(b + ORIGIN * LANES + k)]
        dy = v[U((TCP + 1) * LANES + k)] - w[U(b + (ORIGIN + 1) * LANES + k)]
        dz = v[U((TCP + 2) * LANES + k)] - w[U(b + (ORIGIN + 2) * LANES + k)]
        along = zx * mx + zy * my + zz * mz
        ax, ay, az = along * zx, along * zy, along * zz
        rx, ry, rz = mx - ax, my - ay, mz - az
        X[U(e + k)] = ay * dz - az * dy
        X[U(e + LANES + k)] = az * dx - ax * dz
        X[U(e + 2 * LANES + k)] = ax * dy - ay * dx
        X[U(f + k)] = ry * dz - rz * dy
        X[U(f + LANES + k)] = rz * dx - rx * dz
        X[U(f + 2 * LANES + k)] = rx * dy - ry * dx


@njit(**FAST)
def _turning_columns(w, X, e, f, b):  # type: ignore[no-untyped-def]
    """Write the rotation rows of a joint's two columns, which begin at ``e`` and ``f``."""
    for k in range(LANES):
        zx = w[U(b + (ROTATION + 2) * LANES + k)]
        zy = w[U(b + (ROTATION + 5) * LANES + k)]
        zz = w[U(b + (ROTATION + 8) * LANES + k)]
        mx, my = w[U(b + MOMENT * LANES + k)], w[U(b + (MOMENT + 1) * LANES + k)]
        mz = w[U(b + (MOMENT + 2) * LANES + k)]
        along = zx * mx + zy * my + zz * mz
        X[U(e + 3 * LANES + k)] = along * zx
        X[U(e + 4 * LANES + k)] = along * zy
        X[U(e + 5 * LANES + k)] = along * zz
        X[U(f + 3 * LANES + k)] = mx - along * zx
        X[U(f + 4 * LANES + k)] = my - along * zy
        X[U(f + 5 * LANES + k)] = mz - along * zz


@njit(**JIT)
def nuisance_columns(v, X, tool_rotation, width):  # type: ignore[no-untyped-def]
    """Write d(measured minus predicted) / d(frame step, tool point), negated: first 9 columns."""
    size = width * LANES
    X[: NUISANCES * size] = 0.0
    for j in range(3):
        for k in range(LANES):
            X[j * size + j * LANES + k] = -1.0
            if width == 6:
                X[(3 + j) * size + (3 + j) * LANES + k] = -1.0
    for k in range(LANES):
        x, y, z = v[TCP * LANES + k], v[(TCP + 1) * LANES + k], v[(TCP + 2) * LANES + k]
        X[3 * size + LANES + k], X[3 * size + 2 * LANES + k] = z, -y
        X[4 * size + k], X[4 * size + 2 * LANES + k] = -z, x
        X[5 * size + k], X[5 * size + LANES + k] = y, -x
        # flange axes in base: the TCP's axes turned back by the tool's own rotation
        for j in range(3):
            for i in range(3):
                total = 0.0
                for c in range(3):
                    total += v[(TCP_ROTATION + 3 * i + c) * LANES + k] * tool_rotation[j, c]
                X[(6 + j) * size + i * LANES + k] = total


@njit(**FAST)
def _weigh(X, cells, columns, size):  # type: ignore[no-untyped-def]
    for c in range(columns):
        a = c * size
        for k in range(size):
            X[U(a + k)] *= cells[U(k)]


@njit(**JIT)
def _cells(per_cell, gap, first, end, width, X, column, cells):  # type: ignore[no-untyped-def]
    """Write the right side into its column and the weights; lanes that are over weigh nothing."""
    a = column * width * LANES
    for j in range(width):
        for k in range(LANES):
            over = first + k >= end
            X[a + j * LANES + k] = 0.0 if over else gap[first + k, j]
            cells[j * LANES + k] = 0.0 if over else per_cell[first + k, j]


@njit(**JIT)
def factor_blocks(chain, rows, gap, per_cell, nuisances, first, last, R):  # type: ignore[no-untyped-def]
    """Fold rows first..last of [nuisances | flexibilities | gap], weighed, into R.

    ``gap`` and ``per_cell`` (N, 3 or 6); ``nuisances`` 0 or 9 columns; R (k, k) with
    k = nuisances + 2n + 1. Returns the first row of a block that core.kernels.reference must solve
    (a load that bends too far, angles that are no numbers), or -1; R then lacks what follows.
    """
    n, width = chain.mass.shape[0], gap.shape[1]
    columns, size = nuisances + 2 * n + 1, width * LANES
    w, v = lanes_of(n)
    X, cells = np.empty(columns * size), np.empty(size)
    deflected = bends(chain)
    for r in range(first, last, LANES):
        if not (gather(chain, rows, r, w, v) and settle(chain, w, v, deflected, False)):
            return r
        if nuisances:
            nuisance_columns(v, X, chain.tool_rotation, width)
        flexibility_columns(w, v, X, nuisances, n, width)
        _cells(per_cell, gap, r, last, width, X, columns - 1, cells)
        _weigh(X, cells, columns, size)
        fold(R, X, columns, size)
    return -1
