"""The shortest joint offset that moves the tool as wanted, damped where that one would be long."""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.reference import INNER, JIT

LARGEST_OFFSET = 0.1  # rad: joint offset (norm) beyond which the correction is damped
REGULAR = 1e-8  # smallest over largest pivot from which elimination is as good as eigenvalues
SWEEPS = 30  # of rotations; six by six takes five to nine


@njit(**JIT)
def smallest_offset(J, wanted, offset):  # type: ignore[no-untyped-def]
    """Write the least-squares solution of J offset = wanted, damped to LARGEST_OFFSET.

    Rows of J (6, n) and wanted (6,) are weighted by the lever already. Of many solutions (more than
    six joints, singular poses) the shortest one. Undamped wherever that is short enough, so that
    the wanted pose is met exactly right up to a singularity.
    """
    n = J.shape[1]
    size = min(n, 6)
    # the smaller, regular one of J J^T and J^T J, and what stands right of it
    G, right = np.empty((size, size)), np.empty(size)
    for i in range(size):
        right[i] = wanted[i]
        if n <= 6:
            right[i] = 0.0
            for k in range(6):
                right[i] += J[k, i] * wanted[k]
        for j in range(i + 1):
            total = 0.0
            for k in range(n if n > 6 else 6):
                total += J[i, k] * J[j, k] if n > 6 else J[k, i] * J[k, j]
            G[i, j] = G[j, i] = total
    y = right.copy()
    if _eliminated(G.copy(), y):
        _written(J, y, offset)
        square = 0.0
        for i in range(n):
            square += offset[i] * offset[i]
        if square <= LARGEST_OFFSET * LARGEST_OFFSET:
            return
    _damped(J, G, right, offset)


@njit(**INNER)
def _eliminated(G, y):  # type: ignore[no-untyped-def]
    """Solve G y = y in place by Cholesky's way; returns False where G is nearly singular."""
    size = y.shape[0]
    least, most = np.inf, 0.0
    for i in range(size):
        for j in range(i + 1):
            total = G[i, j]
            for k in range(j):
                total -= G[i, k] * G[j, k]
            if i == j:
                least, most = min(least, total), max(most, total)
                if not least > REGULAR * most:
                    return False
                G[i, i] = np.sqrt(total)
            else:
                G[i, j] = total / G[j, j]
    for i in range(size):
        for k in range(i):
            y[i] -= G[i, k] * y[k]
        y[i] /= G[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            y[i] -= G[k, i] * y[k]
        y[i] /= G[i, i]
    return True


@njit(**INNER)
def _damped(J, G, right, offset):  # type: ignore[no-untyped-def]
    """Write the solution by eigenvalues, with as little damping as keeps it short."""
    wide, size = J.shape[1] > 6, G.shape[0]
    V = np.zeros((size, size))
    for i in range(size):
        V[i, i] = 1.0
    _diagonalised(G, V)
    y, s, most = np.zeros(size), np.empty(size), 1e-12  # s: the squared singular values
    for i in range(size):
        s[i] = max(G[i, i], 0.0)
        most = max(most, s[i])
        for k in range(size):
            y[i] += V[k, i] * right[k]
    damping = 1e-14 * most
    for _ in range(60):
        square = 0.0
        for i in range(size):
            part = y[i] / (s[i] + damping)
            square += part * part * (s[i] if wide else 1.0)
        if square <= LARGEST_OFFSET * LARGEST_OFFSET:
            break
        damping *= 3.0
    found = np.zeros(size)
    for i in range(size):
        for k in range(size):
            found[k] += V[k, i] * (y[i] / (s[i] + damping))
    _written(J, found, offset)


@njit(**INNER)
def _diagonalised(G, V):  # type: ignore[no-untyped-def]
    """Turn G (n, n) into its eigenvalues on the diagonal, and V's columns with it.

    Jacobi's rotations, cyclic. Source: Golub, Van Loan, "Matrix Computations", 8.5. numpy's eigh
    would have numba import scipy.linalg at the first singular pose: 0.2 s, in a live loop too.
    """
    n = G.shape[0]
    for _ in range(SWEEPS):
        off = whole = 0.0
        for i in range(n):
            whole += G[i, i] * G[i, i]
            for j in range(i):
                off += G[i, j] * G[i, j]
        if not off > 1e-32 * whole:
            return
        for p in range(n - 1):
            for q in range(p + 1, n):
                if G[p, q] != 0.0:
                    _rotated(G, V, p, q)


@njit(**INNER)
def _rotated(G, V, p, q):  # type: ignore[no-untyped-def]
    """Take G[p, q] to zero by one rotation."""
    tau = 0.5 * (G[q, q] - G[p, p]) / G[p, q]
    t = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + np.sqrt(1.0 + tau * tau))
    c = 1.0 / np.sqrt(1.0 + t * t)
    s = t * c
    for k in range(G.shape[0]):
        a, b = G[k, p], G[k, q]
        G[k, p], G[k, q] = c * a - s * b, s * a + c * b
    for k in range(G.shape[0]):
        a, b = G[p, k], G[q, k]
        G[p, k], G[q, k] = c * a - s * b, s * a + c * b
    for k in range(G.shape[0]):
        a, b = V[k, p], V[k, q]
        V[k, p], V[k, q] = c * a - s * b, s * a + c * b


@njit(**INNER)
def _written(J, y, offset):  # type: ignore[no-untyped-def]
    """Write the joint offset (n,) that the solution of the smaller system means."""
    n = J.shape[1]
    for i in range(n):
        offset[i] = 0.0 if n > 6 else y[i]
        if n > 6:
            for k in range(6):
                offset[i] += J[k, i] * y[k]
