"""Derivatives of many TCP poses by the parameters of a model: exact, in blocks of lanes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from gapbridge.core.arrays import Array
from gapbridge.core.kernels.adjoint import (
    ADJOINT,
    ADJOINT_RECORD,
    BODY,
    REACTION,
    SHARE,
    SHIFT,
    SUM_SLOTS,
    TWIST,
    prepare,
    solve,
)
from gapbridge.core.kernels.lanes import bends, gather, keep_pose, lanes_of, settle
from gapbridge.core.kernels.layout import (
    AXIS,
    COG,
    FAST,
    LANES,
    LINK_SCALE,
    MASS,
    ORIGIN,
    RECORD,
    TOTAL,
    WRENCH,
    U,
)
from gapbridge.core.kernels.mechanics import in_axes, point_of, put, three
from gapbridge.core.kernels.rates import slots
from gapbridge.core.kernels.reference import INNER, JIT

_L = LANES


class Sums(NamedTuple):
    """Buffers of one coordinate's derivatives: slots of LANES numbers."""

    slots: Array  # of ``rates.ChainRate``, then those that differ from row to row
    reaction: Array  # (3 slots) the records' pushes so far
    turned: Array  # (3 slots) each crossed with its record's origin


@njit(**FAST)
def _in_axes(w, u, B, record, source, slot, scaled):  # type: ignore[no-untyped-def]
    """Write three numbers of the next record (from ``source``) in a record's axes."""
    a = record * RECORD * _L
    for k in range(_L):
        g = w[U(a + LINK_SCALE * _L + k)] if scaled else 1.0
        x, y, z = three(u, source, k)
        x, y, z = in_axes(w, a, k, x, y, z)
        put(B, slot * _L, k, g * x, g * y, g * z)


@njit(**FAST)
def _of_tool(w, v, sums, n, axis, turning):  # type: ignore[no-untyped-def]
    """Write the derivatives by the tool's shift and turn."""
    a, slot, B, reaction = (n + 1) * RECORD * _L, 6 * (n + 1), sums.slots, sums.reaction
    ex, ey = 1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0
    ez = 1.0 if axis == 2 else 0.0
    moved, turned = 0.0 if turning else 1.0, 1.0 if turning else 0.0
    for k in range(_L):
        px, py, pz = three(reaction, 0, k)
        fx, fy, fz = three(v, WRENCH * _L, k)
        x = moved * ex + fy * pz - fz * py
        y = moved * ey + fz * px - fx * pz
        z = moved * ez + fx * py - fy * px
        x, y, z = in_axes(w, a, k, x, y, z)
        put(B, slot * _L, k, x, y, z)
        x, y, z = in_axes(w, a, k, ex, ey, ez)
        put(B, (slot + 3) * _L, k, turned * x, turned * y, turned * z)


@njit(**FAST)
def _of_joint(w, u, B, n, i, p, c2):  # type: ignore[no-untyped-def]
    """Write the derivatives by joint i's compliance and softening, its angle, its link's scale."""
    a, b = (i + 1) * RECORD * _L, (i + 1) * ADJOINT_RECORD * _L
    give, soft, turn = 6 * (n + 2) + 3 * i, 6 * (n + 2) + 3 * n + i, 10 * n + 18 + i
    px, py, pz = p[0], p[1], p[2]
    for k in range(_L):
        mx, my, m = three(u, b + BODY * _L, k)
        share = u[U(b + SHARE * _L + k)]
        x, y, pull = three(u, b + ADJOINT * _L, k)
        put(B, give * _L, k, x * mx, y * my, pull * m * share)
        B[U(soft * _L + k)] = -0.5 * c2 * pull * m * m * m * share * share * share
        x, y, z = three(w, a + AXIS * _L, k)
        tx, ty, tz = three(u, b + TWIST * _L, k)
        B[U(turn * _L + k)] = x * tx + y * ty + z * tz
        x, y, z = three(u, b + (ADJOINT_RECORD + SHIFT) * _L, k)
        x, y, z = in_axes(w, a, k, x, y, z)
        B[U((turn + n) * _L + k)] = px * x + py * y + pz * z


@njit(**FAST)
def _reaction(w, u, sums, record):  # type: ignore[no-untyped-def]
    """Add a record's reaction, and its reaction crossed with its origin, to the two sums."""
    a, b = record * RECORD * _L, record * ADJOINT_RECORD * _L
    reaction, turned = sums.reaction, sums.turned
    for k in range(_L):
        px, py, pz = three(u, b + REACTION * _L, k)
        reaction[U(k)] += px
        reaction[U(_L + k)] += py
        reaction[U(2 * _L + k)] += pz
        if record > 0:
            x, y, z = three(w, a + ORIGIN * _L, k)
            turned[U(k)] += py * z - pz * y
            turned[U(_L + k)] += pz * x - px * z
            turned[U(2 * _L + k)] += px * y - py * x


@njit(inline="always", **FAST)
def _weight_at(w, sums, a, k, x, y, z):  # type: ignore[no-untyped-def]
    """Return the derivative by gravity of one kg at a point of the record that begins at ``a``."""
    px, py, pz = three(sums.reaction, 0, k)
    tx, ty, tz = three(sums.turned, 0, k)
    x, y, z = point_of(w, a, k, x, y, z)
    return py * z - pz * y - tx, pz * x - px * z - ty, px * y - py * x - tz


@njit(**FAST)
def _add_gravity(w, sums, record, m, c, slot):  # type: ignore[no-untyped-def]
    """Add the derivative by gravity of a mass ``m`` at ``c`` (record's axes) to the slots."""
    a, B = record * RECORD * _L, sums.slots
    cx, cy, cz = c[0], c[1], c[2]
    for k in range(_L):
        hx, hy, hz = _weight_at(w, sums, a, k, cx, cy, cz)
        B[U(slot * _L + k)] += m * hx
        B[U((slot + 1) * _L + k)] += m * hy
        B[U((slot + 2) * _L + k)] += m * hz


@njit(**FAST)
def _of_payload(w, v, sums, n, g, gravity):  # type: ignore[no-untyped-def]
    """Write the derivative by the payload's mass; add its derivative by gravity."""
    a, load, B = (n + 1) * RECORD * _L, 12 * n + 18, sums.slots
    gx, gy, gz = g[0], g[1], g[2]
    for k in range(_L):
        cx, cy, cz = three(v, COG * _L, k)
        hx, hy, hz = _weight_at(w, sums, a, k, cx, cy, cz)
        m = v[U(MASS * _L + k)]
        B[U(gravity * _L + k)] += m * hx
        B[U((gravity + 1) * _L + k)] += m * hy
        B[U((gravity + 2) * _L + k)] += m * hz
        B[U(load * _L + k)] = hx * gx + hy * gy + hz * gz


@njit(**INNER)
def _derivatives(chain, lanes, sums, axis, turning, links, loads):  # type: ignore[no-untyped-def]
    """Write the slots of one coordinate; those of links, and of tool and weights, where wanted."""
    n, B = chain.mass.shape[0], sums.slots
    w, v, u, _ = lanes
    gravity = 6 * (n + 2) + 4 * n
    if links:
        for j in range(n + 1):
            source = (j + 1) * ADJOINT_RECORD * _L
            _in_axes(w, u, B, j, source + SHIFT * _L, 6 * j, True)
            _in_axes(w, u, B, j, source + TWIST * _L, 6 * j + 3, False)
    for i in range(n):
        _of_joint(w, u, B, n, i, chain.position[i + 1], chain.compliance[i, 2])
    if loads:
        B[gravity * _L : (gravity + 3) * _L] = 0.0
        sums.reaction[:] = 0.0
        sums.turned[:] = 0.0
        _reaction(w, u, sums, 0)
        for i in range(n):
            _reaction(w, u, sums, i + 1)
            _add_gravity(w, sums, i + 1, chain.mass[i], chain.cog[i], gravity)
        _of_tool(w, v, sums, n, axis, turning)
        _of_payload(w, v, sums, n, chain.gravity, gravity)
    for j in range(3):
        for k in range(_L):
            total = w[RECORD * _L + (TOTAL + 3 + j) * _L + k]
            B[(gravity + 3 + j) * _L + k] = u[(ADJOINT + j) * _L + k] * total


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
def _columns(B, rates, first, count, J, column):  # type: ignore[no-untyped-def]
    """Write one coordinate's column of each parameter: ``J`` (p, N)."""
    (start, slot, rate), (row_start, row_slot, row_rate) = rates
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
def jacobian_blocks(chain, rows, rates, first, last, found, converged):  # type: ignore[no-untyped-def]
    """Write TCP poses of rows first..last, and derivatives J: ``found`` (position, rotation, J).

    J (3 or 6, p, N): derivatives by p parameters, of the position (m) and of the turn (rad), base
    axes. ``rates``: for parameter c the entries start[c]..start[c+1] of (slot, rate), then likewise
    those with a rate per row (entries, N). Slots: ``rates.ChainRate``. ``converged``: of the
    adjoints (m/rad), how much a last round may change. Returns the first row of a block that does
    not settle at once, or -1. The arm's links must not bend themselves.
    """
    n = chain.mass.shape[0]
    position, rotation, J = found
    w, v = lanes_of(n)
    u, s = np.empty((n + 2) * ADJOINT_RECORD * _L), np.empty(SUM_SLOTS * _L)
    lanes, column = (w, v, u, s), np.empty(_L)
    sums = Sums(np.zeros(slots(n) * _L), np.empty(3 * _L), np.empty(3 * _L))
    deflected = bends(chain)
    links = _linked(rates[0][1], n)
    loads = _loaded(rates[0][1], n) or _loaded(rates[1][1], n)
    for r in range(first, last, _L):
        if not (gather(chain, rows, r, w, v) and settle(chain, w, v, deflected, False)):
            return r
        count = min(_L, last - r)
        for k in range(count):
            keep_pose(v, k, position[r + k], rotation[r + k])
        prepare(chain, w, v, u, s)
        for coordinate in range(J.shape[0]):
            axis, turning = coordinate % 3, coordinate >= 3
            if not solve(lanes, axis, turning, deflected, converged):
                return r
            _derivatives(chain, lanes, sums, axis, turning, links, loads)
            _columns(sums.slots, rates, r, count, J[coordinate], column)
    return -1
