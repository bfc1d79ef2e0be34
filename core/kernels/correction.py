"""Corrected setpoints of many rows in blocks of lanes: what kernels.single does row after row.

Newton's method on all lanes at once, each step from the bending of the one before, until the last
lane is there. Lanes near a singularity, where the offset is damped, are left to kernels.single.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.lanes import bends, gather, lanes_of, settle
from gapbridge.core.kernels.layout import (
    ANGLE,
    AXIS,
    FAST,
    LANES,
    ORIGIN,
    RECORD,
    TCP,
    TCP_ROTATION,
    U,
)
from gapbridge.core.kernels.least_offset import LARGEST_OFFSET, REGULAR
from gapbridge.core.kernels.mechanics import put, three
from gapbridge.core.kernels.reference import INNER, JIT
from gapbridge.core.kernels.single import LEVER, TOLERANCE, motion

STEPS = 4  # of Newton's: what takes more is near a singularity
# slots of a workspace of its own, before those whose number depends on the joints
WANTED, ERROR, LEAST, MOST, DISTANCE, SINGULAR, SUM, RIGHT, FACTOR = (
    0,
    12,
    18,
    19,
    20,
    21,
    22,
    23,
    29,
)
OFFSET = FACTOR + 36  # (n,), then nominal angles (n,), then the Jacobian, column after column
_L = LANES


@njit(**JIT)
def correct_blocks(chain, rigid, rows, first, last, out):  # type: ignore[no-untyped-def]
    """Write corrected setpoints of rows first..last: found (N, n + 6), residual, steps (N,).

    As ``kernels.single.correct_rows`` does; ``rows.q`` are the nominal setpoints, ``rigid`` is the
    effect-free arm. Rows that are left to it come back with no steps.
    """
    n = chain.mass.shape[0]
    found, residual, steps = out
    w, v = lanes_of(n)
    x, wanted, reached = np.zeros((OFFSET + 8 * n) * _L), np.empty(12), np.empty(12)
    deflected = bends(chain)
    for r in range(first, last, _L):
        count = min(_L, last - r)
        steps[r : r + count] = 0
        if not gather(chain, rows, r, w, v):
            continue
        _begin(w, x, n)
        taken = 0
        if settle(rigid, w, v, False, False):
            _keep_pose(v, x)
            taken = _solve(chain, w, v, x, n, deflected)
        if not taken:
            continue
        settle(rigid, w, v, False, False)
        for k in range(count):
            if x[SINGULAR * _L + k] == 0.0 and x[DISTANCE * _L + k] < TOLERANCE:
                steps[r + k], residual[r + k] = taken, x[DISTANCE * _L + k]
                for i in range(n):
                    found[r + k, i] = w[((i + 1) * RECORD + ANGLE) * _L + k]
                for s in range(12):
                    wanted[s], reached[s] = x[(WANTED + s) * _L + k], v[(TCP + s) * _L + k]
                motion(wanted, reached, True, found[r + k, n:])


@njit(**INNER)
def _solve(chain, w, v, x, n, deflected):  # type: ignore[no-untyped-def]
    """Bring all lanes that can be to the wanted pose; returns the steps, 0: no equilibrium."""
    for step in range(STEPS):
        for i in range(n):
            _turned(w, x, i, n)
        if not settle(chain, w, v, deflected, step > 0):
            return 0
        _distance(v, x)
        farthest = 0.0
        for k in range(_L):
            if x[SINGULAR * _L + k] == 0.0:
                farthest = max(farthest, x[DISTANCE * _L + k])
        if farthest < TOLERANCE or step == STEPS - 1:
            return step + 1
        for i in range(n):
            _column(w, v, x, i, n)
        _shortest(x, n)
    return 0


@njit(**FAST)
def _begin(w, x, n):  # type: ignore[no-untyped-def]
    """Keep the nominal angles; no offset yet, and no lane is singular."""
    for i in range(n):
        for k in range(_L):
            x[U((OFFSET + i) * _L + k)] = 0.0
            x[U((OFFSET + n + i) * _L + k)] = w[U(((i + 1) * RECORD + ANGLE) * _L + k)]
    for k in range(_L):
        x[U(SINGULAR * _L + k)] = 0.0


@njit(**FAST)
def _turned(w, x, i, n):  # type: ignore[no-untyped-def]
    """Turn a joint to its nominal angle and the offset."""
    for k in range(_L):
        w[U(((i + 1) * RECORD + ANGLE) * _L + k)] = (
            x[U((OFFSET + n + i) * _L + k)] + x[U((OFFSET + i) * _L + k)]
        )


@njit(**FAST)
def _keep_pose(v, x):  # type: ignore[no-untyped-def]
    """Keep the lanes' TCP as the wanted one."""
    for s in range(12 * _L):
        x[U(WANTED * _L + s)] = v[U(TCP * _L + s)]


@njit(**FAST)
def _distance(v, x):  # type: ignore[no-untyped-def]
    """Write wanted minus predicted pose, the rotation times LEVER, and its length."""
    for k in range(_L):
        square = 0.0
        for j in range(3):
            e = x[U((WANTED + j) * _L + k)] - v[U((TCP + j) * _L + k)]
            x[U((ERROR + j) * _L + k)] = e
            square += e * e
        e0 = e1 = e2 = 0.0
        # for small angles the rotation vector of R_wanted R^T is half the sum of columns' products
        for c in range(3):
            r0 = v[U((TCP_ROTATION + c) * _L + k)]
            r1 = v[U((TCP_ROTATION + 3 + c) * _L + k)]
            r2 = v[U((TCP_ROTATION + 6 + c) * _L + k)]
            v0, v1 = x[U((WANTED + 3 + c) * _L + k)], x[U((WANTED + 6 + c) * _L + k)]
            v2 = x[U((WANTED + 9 + c) * _L + k)]
            e0 += r1 * v2 - r2 * v1
            e1 += r2 * v0 - r0 * v2
            e2 += r0 * v1 - r1 * v0
        e0, e1, e2 = 0.5 * LEVER * e0, 0.5 * LEVER * e1, 0.5 * LEVER * e2
        put(x, (ERROR + 3) * _L, k, e0, e1, e2)
        x[U(DISTANCE * _L + k)] = np.sqrt(square + e0 * e0 + e1 * e1 + e2 * e2)


@njit(**FAST)
def _column(w, v, x, i, n):  # type: ignore[no-untyped-def]
    """Write a joint's column of the Jacobian; add what its offset so far is to the error.

    The whole offset is solved for, not an increment.
    """
    a, c = (i + 1) * RECORD * _L, (OFFSET + 2 * n + 6 * i) * _L
    for k in range(_L):
        zx, zy, zz = three(w, a + AXIS * _L, k)
        px, py, pz = three(v, TCP * _L, k)
        ox, oy, oz = three(w, a + ORIGIN * _L, k)
        px, py, pz = px - ox, py - oy, pz - oz
        put(x, c, k, zy * pz - zz * py, zz * px - zx * pz, zx * py - zy * px)
        put(x, c + 3 * _L, k, LEVER * zx, LEVER * zy, LEVER * zz)
        offset = x[U((OFFSET + i) * _L + k)]
        for j in range(6):
            x[U((ERROR + j) * _L + k)] += x[U(c + j * _L + k)] * offset


@njit(**INNER)
def _shortest(x, n):  # type: ignore[no-untyped-def]
    """Write the shortest offset that takes up the error; marks lanes where it would be damped.

    By Cholesky's factor of the smaller one of J'J and JJ', as ``least_offset`` does.
    """
    J, wide = OFFSET + 2 * n, n > 6
    size, terms = (6, n) if wide else (n, 6)
    apart, along = (1, 6) if wide else (6, 1)  # slots between rows, and between terms of a row
    x[LEAST * _L : (LEAST + 1) * _L] = np.inf
    x[MOST * _L : (MOST + 1) * _L] = 0.0
    for i in range(size):
        right = (RIGHT + i) * _L
        if wide:
            _copied(x, (ERROR + i) * _L, right)
        else:
            _product(x, right, (J + 6 * i) * _L, _L, ERROR * _L, _L, 6)
        for j in range(i + 1):
            entry = (FACTOR + 6 * i + j) * _L
            _product(
                x, entry, (J + apart * i) * _L, along * _L, (J + apart * j) * _L, along * _L, terms
            )
            _less(x, entry, (FACTOR + 6 * i) * _L, _L, (FACTOR + 6 * j) * _L, _L, j)
            if j < i:
                _scaled(x, entry, (FACTOR + 7 * j) * _L)
        _pivot(x, (FACTOR + 7 * i) * _L)
        _less(x, right, (FACTOR + 6 * i) * _L, _L, RIGHT * _L, _L, i)
        _scaled(x, right, (FACTOR + 7 * i) * _L)
    for i in range(size - 1, -1, -1):
        right, left = (RIGHT + i) * _L, size - 1 - i
        _less(x, right, (FACTOR + 7 * i + 6) * _L, 6 * _L, right + _L, _L, left)
        _scaled(x, right, (FACTOR + 7 * i) * _L)
    for i in range(n):
        if wide:
            _product(x, (OFFSET + i) * _L, (J + 6 * i) * _L, _L, RIGHT * _L, _L, 6)
        else:
            _copied(x, (RIGHT + i) * _L, (OFFSET + i) * _L)
    _product(x, SUM * _L, OFFSET * _L, _L, OFFSET * _L, _L, n)
    _mark(x, n)


@njit(**FAST)
def _copied(x, source, to):  # type: ignore[no-untyped-def]
    for k in range(_L):
        x[U(to + k)] = x[U(source + k)]


@njit(**FAST)
def _product(x, to, a, a_step, b, b_step, terms):  # type: ignore[no-untyped-def]
    """Write the sum over ``terms`` slots of the products of two rows of slots."""
    for k in range(_L):
        x[U(to + k)] = x[U(a + k)] * x[U(b + k)]
    for t in range(1, terms):
        p, q = a + t * a_step, b + t * b_step
        for k in range(_L):
            x[U(to + k)] += x[U(p + k)] * x[U(q + k)]


@njit(**FAST)
def _less(x, to, a, a_step, b, b_step, terms):  # type: ignore[no-untyped-def]
    """Subtract what ``_product`` would write."""
    for t in range(terms):
        p, q = a + t * a_step, b + t * b_step
        for k in range(_L):
            x[U(to + k)] -= x[U(p + k)] * x[U(q + k)]


@njit(**FAST)
def _scaled(x, to, by):  # type: ignore[no-untyped-def]
    for k in range(_L):
        x[U(to + k)] *= x[U(by + k)]


@njit(**FAST)
def _pivot(x, at):  # type: ignore[no-untyped-def]
    """Replace a pivot by what its row is multiplied with; keep the least and the most of them."""
    for k in range(_L):
        pivot = x[U(at + k)]
        least, most = x[U(LEAST * _L + k)], x[U(MOST * _L + k)]
        x[U(LEAST * _L + k)] = pivot if pivot < least else least
        x[U(MOST * _L + k)] = pivot if pivot > most else most
        x[U(at + k)] = 1.0 / np.sqrt(pivot if pivot > 1e-300 else 1e-300)


@njit(**FAST)
def _mark(x, n):  # type: ignore[no-untyped-def]
    """Mark the lanes whose offset ``least_offset`` would damp, and take it from them."""
    for k in range(_L):
        regular = (
            x[U(LEAST * _L + k)] > REGULAR * x[U(MOST * _L + k)]
            and x[U(SUM * _L + k)] <= LARGEST_OFFSET * LARGEST_OFFSET
        )
        if not regular:
            x[U(SINGULAR * _L + k)] = 1.0
            for i in range(n):
                x[U((OFFSET + i) * _L + k)] = 0.0
