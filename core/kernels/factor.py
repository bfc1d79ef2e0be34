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
    SUMS,
    TCP,
    TCP_ROTATION,
    U,
)
from gapbridge.core.kernels.mechanics import put, three
from gapbridge.core.kernels.reference import INNER, JIT

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


@njit(inline="always", **FAST)
def _moments(w, b, k):  # type: ignore[no-untyped-def]
    """Return a joint's moment along its axis, and the rest of it, base axes."""
    zx = w[U(b + (ROTATION + 2) * LANES + k)]
    zy = w[U(b + (ROTATION + 5) * LANES + k)]
    zz = w[U(b + (ROTATION + 8) * LANES + k)]
    mx, my, mz = three(w, b + MOMENT * LANES, k)
    along = zx * mx + zy * my + zz * mz
    ax, ay, az = along * zx, along * zy, along * zz
    return ax, ay, az, mx - ax, my - ay, mz - az


@njit(**FAST)
def _shift_columns(w, v, X, b, e, f):  # type: ignore[no-untyped-def]
    """Write the position rows of a joint's two columns, which begin at ``e`` and ``f``.

    A function of its own: in a loop over joints the compiler makes no vector instructions of it.
    """
    for k in range(LANES):
        ax, ay, az, rx, ry, rz = _moments(w, b, k)
        x, y, z = three(v, TCP * LANES, k)
        ox, oy, oz = three(w, b + ORIGIN * LANES, k)
        dx, dy, dz = x - ox, y - oy, z - oz
        put(X, e, k, ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx)
        put(X, f, k, ry * dz - rz * dy, rz * dx - rx * dz, rx * dy - ry * dx)


@njit(**FAST)
def _turning_columns(w, X, e, f, b):  # type: ignore[no-untyped-def]
    """Write the rotation rows of a joint's two columns, which begin at ``e`` and ``f``."""
    for k in range(LANES):
        ax, ay, az, rx, ry, rz = _moments(w, b, k)
        put(X, e + 3 * LANES, k, ax, ay, az)
        put(X, f + 3 * LANES, k, rx, ry, rz)


@njit(**INNER)
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


@njit(**INNER)
def _cells(per_cell, gap, first, end, right, cells):  # type: ignore[no-untyped-def]
    """Write the right side and the weights; lanes that are over weigh nothing."""
    for j in range(gap.shape[1]):
        for k in range(LANES):
            over = first + k >= end
            right[j * LANES + k] = 0.0 if over else gap[first + k, j]
            cells[j * LANES + k] = 0.0 if over else per_cell[first + k, j]


@njit(**JIT)
def factor_blocks(chain, rows, gap, per_cell, first, last, R):  # type: ignore[no-untyped-def]
    """Fold rows first..last of [nuisances | flexibilities | gap], weighed, into R.

    ``gap`` and ``per_cell`` (N, 3 or 6); R (k, k) with k = 2n + 1, and NUISANCES more where there
    are such columns. Returns the first row of a block that core.kernels.reference must solve
    (a load that bends too far, angles that are no numbers), or -1; R then lacks what follows.
    """
    n, width = chain.mass.shape[0], gap.shape[1]
    columns, size = R.shape[0], width * LANES
    nuisances = columns - 2 * n - 1
    w, v = lanes_of(n)
    X, cells = np.empty(columns * size), np.empty(size)
    deflected = bends(chain)
    for r in range(first, last, LANES):
        if not (gather(chain, rows, r, w, v) and settle(chain, w, v, deflected, False)):
            return r
        if nuisances:
            nuisance_columns(v, X, chain.tool_rotation, width)
        flexibility_columns(w, v, X, nuisances, n, width)
        _cells(per_cell, gap, r, last, X[(columns - 1) * size :], cells)
        _weigh(X, cells, columns, size)
        fold(R, X, columns, size)
    return -1


@njit(**SUMS)
def _reflect(X, size, lead, R, j, c):  # type: ignore[no-untyped-def]
    """Reflect column c, and its entry in row j of R, on column j."""
    a, b = j * size, c * size
    product = 0.0
    for k in range(size):
        product += X[U(a + k)] * X[U(b + k)]
    step = -lead / R[j, j] * (R[j, c] + product / lead)
    R[j, c] -= step
    part = step / lead
    for k in range(size):
        X[U(b + k)] -= part * X[U(a + k)]


@njit(**SUMS)
def _reflect_four(X, size, lead, R, j, c):  # type: ignore[no-untyped-def]
    """``_reflect`` four columns at once: column j is read a quarter as often."""
    a, b = j * size, c * size
    p0 = p1 = p2 = p3 = 0.0
    for k in range(size):
        x = X[U(a + k)]
        p0 += x * X[U(b + k)]
        p1 += x * X[U(b + size + k)]
        p2 += x * X[U(b + 2 * size + k)]
        p3 += x * X[U(b + 3 * size + k)]
    share = -lead / R[j, j]
    s0, s1 = share * (R[j, c] + p0 / lead), share * (R[j, c + 1] + p1 / lead)
    s2, s3 = share * (R[j, c + 2] + p2 / lead), share * (R[j, c + 3] + p3 / lead)
    R[j, c] -= s0
    R[j, c + 1] -= s1
    R[j, c + 2] -= s2
    R[j, c + 3] -= s3
    s0, s1, s2, s3 = s0 / lead, s1 / lead, s2 / lead, s3 / lead
    for k in range(size):
        x = X[U(a + k)]
        X[U(b + k)] -= s0 * x
        X[U(b + size + k)] -= s1 * x
        X[U(b + 2 * size + k)] -= s2 * x
        X[U(b + 3 * size + k)] -= s3 * x


@njit(**SUMS)
def fold(R, X, columns, size):  # type: ignore[no-untyped-def]
    """Fold a block X (column after column of ``size`` numbers, spoilt) into R (columns, columns).

    R'R grows by X'X: Householder reflections of R above the block, of which a column reaches one
    row of R only. As accurate as a QR factorisation of all blocks at once.
    """
    for j in range(columns):
        a = j * size
        square = 0.0
        for k in range(size):
            square += X[U(a + k)] * X[U(a + k)]
        if square == 0.0:
            continue
        head = R[j, j]
        norm = np.sqrt(head * head + square)
        pivot = -norm if head > 0.0 else norm
        lead = head - pivot
        R[j, j] = pivot
        c = j + 1
        while c + 4 <= columns:
            _reflect_four(X, size, lead, R, j, c)
            c += 4
        while c < columns:
            _reflect(X, size, lead, R, j, c)
            c += 1
