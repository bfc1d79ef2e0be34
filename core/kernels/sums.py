"""What a block of columns adds to a triangular factor, or to a normal matrix."""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.layout import SUMS, U
from gapbridge.core.kernels.reference import JIT


@njit(**SUMS)
def _reflect(X, a, b, size, lead, share, r):  # type: ignore[no-untyped-def]
    """Reflect the column at ``b``, and its row entry r, on the one at ``a``; returns the entry."""
    product = 0.0
    for k in range(size):
        product += X[U(a + k)] * X[U(b + k)]
    step = share * (r + product / lead)
    part = step / lead
    for k in range(size):
        X[U(b + k)] -= part * X[U(a + k)]
    return r - step


@njit(**SUMS)
def _reflect_four(X, a, b, size, lead, share, R, j, c):  # type: ignore[no-untyped-def]
    """``_reflect`` four columns at once: the one at ``a`` is read a quarter as often."""
    p0 = p1 = p2 = p3 = 0.0
    for k in range(size):
        x = X[U(a + k)]
        p0 += x * X[U(b + k)]
        p1 += x * X[U(b + size + k)]
        p2 += x * X[U(b + 2 * size + k)]
        p3 += x * X[U(b + 3 * size + k)]
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
        share = -lead / pivot
        R[j, j] = pivot
        c = j + 1
        while c + 4 <= columns:
            _reflect_four(X, a, c * size, size, lead, share, R, j, c)
            c += 4
        while c < columns:
            R[j, c] = _reflect(X, a, c * size, size, lead, share, R[j, c])
            c += 1


@njit(**SUMS)
def _tile(G, X, i, j, size):  # type: ignore[no-untyped-def]
    """Add the products of four columns from i with four from j to G."""
    a, b = i * size, j * size
    g00 = g01 = g02 = g03 = g10 = g11 = g12 = g13 = 0.0
    g20 = g21 = g22 = g23 = g30 = g31 = g32 = g33 = 0.0
    for k in range(size):
        x0, x1 = X[U(a + k)], X[U(a + size + k)]
        x2, x3 = X[U(a + 2 * size + k)], X[U(a + 3 * size + k)]
        y0, y1 = X[U(b + k)], X[U(b + size + k)]
        y2, y3 = X[U(b + 2 * size + k)], X[U(b + 3 * size + k)]
        g00 += x0 * y0
        g01 += x0 * y1
        g02 += x0 * y2
        g03 += x0 * y3
        g10 += x1 * y0
        g11 += x1 * y1
        g12 += x1 * y2
        g13 += x1 * y3
        g20 += x2 * y0
        g21 += x2 * y1
        g22 += x2 * y2
        g23 += x2 * y3
        g30 += x3 * y0
        g31 += x3 * y1
        g32 += x3 * y2
        g33 += x3 * y3
    G[i, j] += g00
    G[i, j + 1] += g01
    G[i, j + 2] += g02
    G[i, j + 3] += g03
    G[i + 1, j] += g10
    G[i + 1, j + 1] += g11
    G[i + 1, j + 2] += g12
    G[i + 1, j + 3] += g13
    G[i + 2, j] += g20
    G[i + 2, j + 1] += g21
    G[i + 2, j + 2] += g22
    G[i + 2, j + 3] += g23
    G[i + 3, j] += g30
    G[i + 3, j + 1] += g31
    G[i + 3, j + 2] += g32
    G[i + 3, j + 3] += g33


@njit(**JIT)
def add_products(G, X, columns, size):  # type: ignore[no-untyped-def]
    """Add X'X to G (columns, columns), tile by tile; ``columns`` is a multiple of four.

    On and below the diagonal's tiles only.
    """
    for i in range(0, columns, 4):
        for j in range(0, i + 4, 4):
            _tile(G, X, i, j, size)
