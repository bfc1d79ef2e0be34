"""What a block of columns adds to a triangular factor."""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.layout import SUMS, U


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
