"""Derivatives of many TCP poses by the parameters of a model: exact, in blocks of lanes."""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.adjoint import (
    BESIDE,
    BODY,
    OWN,
    PULL,
    PUSH,
    SHARE,
    SHIFT,
    TWIST,
    prepare,
    solve,
)
from gapbridge.core.kernels.lanes import bends, gather, lanes_of, settle
from gapbridge.core.kernels.layout import (
    AXIS,
    COG,
    FAST,
    GROWTH,
    LANES,
    MASS,
    ORIGIN,
    RECORD,
    ROTATION,
    TCP,
    TCP_ROTATION,
    TOTAL,
    WRENCH,
    U,
)
from gapbridge.core.kernels.rates import slots
from gapbridge.core.kernels.reference import INNER, JIT

_L = LANES


@njit(**FAST)
def _in_axes(w, u, B, record, source, slot, grows):  # type: ignore[no-untyped-def]
    """Write three numbers of the next record (from ``source``) in a record's axes."""
    a = record * RECORD * _L
    for k in range(_L):
        g = w[U(a + GROWTH * _L + k)] if grows else 1.0
        x, y, z = u[U(source + k)], u[U(source + _L + k)], u[U(source + 2 * _L + k)]
        for j in range(3):
            B[U((slot + j) * _L + k)] = g * (
                w[U(a + (ROTATION + j) * _L + k)] * x
                + w[U(a + (ROTATION + 3 + j) * _L + k)] * y
                + w[U(a + (ROTATION + 6 + j) * _L + k)] * z
            )


@njit(**FAST)
def _of_tool(w, v, B, n, slot, push, axis, turning):  # type: ignore[no-untyped-def]
    """Write the derivatives by the tool's shift and turn; ``push`` (3 slots): the joints' sum."""
    a = (n + 1) * RECORD * _L
    ex, ey = 1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0
    ez = 1.0 if axis == 2 else 0.0
    moved, turned = 0.0 if turning else 1.0, 1.0 if turning else 0.0
    for k in range(_L):
        px, py, pz = push[U(k)], push[U(_L + k)], push[U(2 * _L + k)]
        fx, fy = v[U(WRENCH * _L + k)], v[U((WRENCH + 1) * _L + k)]
        fz = v[U((WRENCH + 2) * _L + k)]
        x = moved * ex + fy * pz - fz * py
        y = moved * ey + fz * px - fx * pz
        z = moved * ez + fx * py - fy * px
        for j in range(3):
            r0 = w[U(a + (ROTATION + j) * _L + k)]
            r1 = w[U(a + (ROTATION + 3 + j) * _L + k)]
            r2 = w[U(a + (ROTATION + 6 + j) * _L + k)]
            B[U((slot + j) * _L + k)] = r0 * x + r1 * y + r2 * z
            B[U((slot + 3 + j) * _L + k)] = turned * (r0 * ex + r1 * ey + r2 * ez)


@njit(**FAST)
def _of_joint(w, u, B, n, i, p, c2):  # type: ignore[no-untyped-def]
    """Write the derivatives by joint i's compliance and softening, its angle, its link's growth."""
    a, b = (i + 1) * RECORD * _L, (i + 1) * OWN * _L
    give, soft, turn = 6 * (n + 2) + 3 * i, 6 * (n + 2) + 3 * n + i, 10 * n + 18 + i
    px, py, pz = p[0], p[1], p[2]
    for k in range(_L):
        m = u[U(b + (BODY + 2) * _L + k)]
        share = u[U(b + SHARE * _L + k)]
        pull = u[U(b + (PULL + 2) * _L + k)]
        B[U(give * _L + k)] = u[U(b + PULL * _L + k)] * u[U(b + BODY * _L + k)]
        B[U((give + 1) * _L + k)] = u[U(b + (PULL + 1) * _L + k)] * u[U(b + (BODY + 1) * _L + k)]
        B[U((give + 2) * _L + k)] = pull * m * share
        B[U(soft * _L + k)] = -0.5 * c2 * pull * m * m * m * share * share * share
        B[U(turn * _L + k)] = (
            w[U(a + AXIS * _L + k)] * u[U(b + TWIST * _L + k)]
            + w[U(a + (AXIS + 1) * _L + k)] * u[U(b + (TWIST + 1) * _L + k)]
            + w[U(a + (AXIS + 2) * _L + k)] * u[U(b + (TWIST + 2) * _L + k)]
        )
        sx = u[U(b + (OWN + SHIFT) * _L + k)]
        sy = u[U(b + (OWN + SHIFT + 1) * _L + k)]
        sz = u[U(b + (OWN + SHIFT + 2) * _L + k)]
        B[U((turn + n) * _L + k)] = (
            px * (w[U(a + ROTATION * _L + k)] * sx + w[U(a + (ROTATION + 3) * _L + k)] * sy
                  + w[U(a + (ROTATION + 6) * _L + k)] * sz)
            + py * (w[U(a + (ROTATION + 1) * _L + k)] * sx + w[U(a + (ROTATION + 4) * _L + k)] * sy
                    + w[U(a + (ROTATION + 7) * _L + k)] * sz)
            + pz * (w[U(a + (ROTATION + 2) * _L + k)] * sx + w[U(a + (ROTATION + 5) * _L + k)] * sy
                    + w[U(a + (ROTATION + 8) * _L + k)] * sz)
        )  # fmt: skip


@njit(**FAST)
def _reaction(w, u, push, turned, record):  # type: ignore[no-untyped-def]
    """Add a record's push to the sum, and its push crossed with its origin to the other sum."""
    a, b = record * RECORD * _L, record * OWN * _L
    for k in range(_L):
        px, py = u[U(b + PUSH * _L + k)], u[U(b + (PUSH + 1) * _L + k)]
        pz = u[U(b + (PUSH + 2) * _L + k)]
        push[U(k)] += px
        push[U(_L + k)] += py
        push[U(2 * _L + k)] += pz
        if record > 0:
            x, y = w[U(a + ORIGIN * _L + k)], w[U(a + (ORIGIN + 1) * _L + k)]
            z = w[U(a + (ORIGIN + 2) * _L + k)]
            turned[U(k)] += py * z - pz * y
            turned[U(_L + k)] += pz * x - px * z
            turned[U(2 * _L + k)] += px * y - py * x


@njit(**FAST)
def _add_gravity(w, B, push, turned, record, m, c, slot):  # type: ignore[no-untyped-def]
    """Add the derivative by gravity of a mass ``m`` at ``c`` (record's axes) to the slots."""
    a = record * RECORD * _L
    cx, cy, cz = c[0], c[1], c[2]
    for k in range(_L):
        px, py, pz = push[U(k)], push[U(_L + k)], push[U(2 * _L + k)]
        x = w[U(a + ORIGIN * _L + k)] + (
            w[U(a + ROTATION * _L + k)] * cx + w[U(a + (ROTATION + 1) * _L + k)] * cy
            + w[U(a + (ROTATION + 2) * _L + k)] * cz
        )  # fmt: skip
        y = w[U(a + (ORIGIN + 1) * _L + k)] + (
            w[U(a + (ROTATION + 3) * _L + k)] * cx + w[U(a + (ROTATION + 4) * _L + k)] * cy
            + w[U(a + (ROTATION + 5) * _L + k)] * cz
        )  # fmt: skip
        z = w[U(a + (ORIGIN + 2) * _L + k)] + (
            w[U(a + (ROTATION + 6) * _L + k)] * cx + w[U(a + (ROTATION + 7) * _L + k)] * cy
            + w[U(a + (ROTATION + 8) * _L + k)] * cz
        )  # fmt: skip
        B[U(slot * _L + k)] += m * (py * z - pz * y - turned[U(k)])
        B[U((slot + 1) * _L + k)] += m * (pz * x - px * z - turned[U(_L + k)])
        B[U((slot + 2) * _L + k)] += m * (px * y - py * x - turned[U(2 * _L + k)])


@njit(**FAST)
def _of_payload(w, v, B, push, turned, n, g, gravity):  # type: ignore[no-untyped-def]
    """Write the derivative by the payload's mass; add its derivative by gravity."""
    a, load = (n + 1) * RECORD * _L, 12 * n + 18
    gx, gy, gz = g[0], g[1], g[2]
    for k in range(_L):
        cx, cy, cz = v[U(COG * _L + k)], v[U((COG + 1) * _L + k)], v[U((COG + 2) * _L + k)]
        px, py, pz = push[U(k)], push[U(_L + k)], push[U(2 * _L + k)]
        x = w[U(a + ORIGIN * _L + k)] + (
            w[U(a + ROTATION * _L + k)] * cx + w[U(a + (ROTATION + 1) * _L + k)] * cy
            + w[U(a + (ROTATION + 2) * _L + k)] * cz
        )  # fmt: skip
        y = w[U(a + (ORIGIN + 1) * _L + k)] + (
            w[U(a + (ROTATION + 3) * _L + k)] * cx + w[U(a + (ROTATION + 4) * _L + k)] * cy
            + w[U(a + (ROTATION + 5) * _L + k)] * cz
        )  # fmt: skip
        z = w[U(a + (ORIGIN + 2) * _L + k)] + (
            w[U(a + (ROTATION + 6) * _L + k)] * cx + w[U(a + (ROTATION + 7) * _L + k)] * cy
            + w[U(a + (ROTATION + 8) * _L + k)] * cz
        )  # fmt: skip
        hx = py * z - pz * y - turned[U(k)]
        hy = pz * x - px * z - turned[U(_L + k)]
        hz = px * y - py * x - turned[U(2 * _L + k)]
        m = v[U(MASS * _L + k)]
        B[U(gravity * _L + k)] += m * hx
        B[U((gravity + 1) * _L + k)] += m * hy
        B[U((gravity + 2) * _L + k)] += m * hz
        B[U(load * _L + k)] = hx * gx + hy * gy + hz * gz


@njit(**INNER)
def _derivatives(chain, w, v, u, B, push, turned, axis, turning, links, loads):  # type: ignore[no-untyped-def]
    """Write the slots of one coordinate; those of links, and of tool and weights, where wanted."""
    n = chain.mass.shape[0]
    gravity = 6 * (n + 2) + 4 * n
    if links:
        for j in range(n + 1):
            source = (j + 1) * OWN * _L
            _in_axes(w, u, B, j, source + SHIFT * _L, 6 * j, True)
            _in_axes(w, u, B, j, source + TWIST * _L, 6 * j + 3, False)
    for i in range(n):
        _of_joint(w, u, B, n, i, chain.position[i + 1], chain.compliance[i, 2])
    if loads:
        B[gravity * _L : (gravity + 3) * _L] = 0.0
        push[:] = 0.0
        turned[:] = 0.0
        _reaction(w, u, push, turned, 0)
        for i in range(n):
            _reaction(w, u, push, turned, i + 1)
            _add_gravity(w, B, push, turned, i + 1, chain.mass[i], chain.cog[i], gravity)
        _of_tool(w, v, B, n, 6 * (n + 1), push, axis, turning)
        _of_payload(w, v, B, push, turned, n, chain.gravity, gravity)
    for j in range(3):
        for k in range(_L):
            total = w[RECORD * _L + (TOTAL + 3 + j) * _L + k]
            B[(gravity + 3 + j) * _L + k] = u[(PULL + j) * _L + k] * total


@njit(**INNER)
def _linked(used, n):  # type: ignore[no-untyped-def]
    """Return whether a parameter moves a link's geometry."""
    found = False
    for slot in used:
        found = found or slot < 6 * (n + 1)
    return found


@njit(**INNER)
def _loaded(used, n):  # type: ignore[no-untyped-def]
    """Return whether a parameter moves the tool, gravity or the payload's mass."""
    tool, gravity = 6 * (n + 1), 6 * (n + 2) + 4 * n
    for slot in used:
        if tool <= slot < tool + 6 or gravity <= slot < gravity + 3 or slot == 12 * n + 18:
            return True
    return False


@njit(**FAST)
def _add(B, b, column, rate):  # type: ignore[no-untyped-def]
    for k in range(_L):
        column[U(k)] += rate * B[U(b + k)]


@njit(**INNER)
def _columns(B, rates, varying, first, count, J, column):  # type: ignore[no-untyped-def]
    """Write one coordinate's column of each parameter: ``J`` (p, N)."""
    start, slot, rate = rates
    row_start, row_slot, row_rate = varying
    for c in range(J.shape[0]):
        column[:] = 0.0
        for e in range(start[c], start[c + 1]):
            _add(B, slot[e] * _L, column, rate[e])
        for e in range(row_start[c], row_start[c + 1]):
            b = row_slot[e] * _L
            for k in range(count):
                column[k] += row_rate[e, first + k] * B[b + k]
        for k in range(count):
            J[c, first + k] = column[k]


@njit(**JIT)
def jacobian_blocks(chain, rows, rates, varying, first, last, position, rotation, J, converged):  # type: ignore[no-untyped-def]
    """Write TCP poses of rows first..last, and their derivatives J (3 or 6, p, N).

    Derivatives by p parameters, of the position (m) and of the turn (rad), base axes. ``rates``:
    for parameter c the entries start[c]..start[c+1] of (slot, rate); ``varying`` likewise, with a
    rate per row (entries, N). Slots: ``rates.ChainRate``. ``converged``: of the adjoints (m/rad),
    how much a last round may change. Returns the first row of a block that does not settle at once,
    or -1. The arm's links must not bend themselves.
    """
    n = chain.mass.shape[0]
    w, v = lanes_of(n)
    u, s = np.empty((n + 2) * OWN * _L), np.empty(BESIDE * _L)
    B, column = np.zeros(slots(n) * _L), np.empty(_L)
    push, turned = np.empty(3 * _L), np.empty(3 * _L)
    deflected = bends(chain)
    links, loads = _linked(rates[1], n), _loaded(rates[1], n) or _loaded(varying[1], n)
    for r in range(first, last, _L):
        if not (gather(chain, rows, r, w, v) and settle(chain, w, v, deflected, False)):
            return r
        count = min(_L, last - r)
        for k in range(count):
            for j in range(3):
                position[r + k, j] = v[(TCP + j) * _L + k]
                for i in range(3):
                    rotation[r + k, j, i] = v[(TCP_ROTATION + 3 * j + i) * _L + k]
        prepare(chain, w, v, u, s)
        for coordinate in range(J.shape[0]):
            axis, turning = coordinate % 3, coordinate >= 3
            if not solve(w, v, u, s, n, axis, turning, deflected, converged):
                return r
            _derivatives(chain, w, v, u, B, push, turned, axis, turning, links, loads)
            _columns(B, rates, varying, r, count, J[coordinate], column)
    return -1
