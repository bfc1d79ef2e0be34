"""Gradient of one coordinate of the TCP by all parameters of a bending chain: exact, by adjoints.

The bending x of all joints satisfies x = C M(x, p). A coordinate y(x, p) then has the derivative
dy/dp = y_p + a C M_p with the adjoint a = y_x + a C M_x, solved by fixed-point iteration (with the
contraction of the equilibrium). All perturbations are twists of the chain beyond some frame: one
sweep out and one back give the derivatives for every frame.
Source: implicit differentiation; statics as in core.kernels.reference (paper eqs. 6-8).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.layout import (
    BEND,
    COG,
    FAST,
    LANES,
    MASS,
    MOMENT,
    ORIGIN,
    RECORD,
    ROTATION,
    TCP,
    TOTAL,
    WRENCH,
    U,
)
from gapbridge.core.kernels.mechanics import change_to, in_axes, put, three
from gapbridge.core.kernels.reference import INNER

# slots of a record of this workspace; records as in layout
MOMENT_RATE, GIVE, BODY, ADJOINT, REACTION, SHIFT, TWIST = 0, 9, 12, 15, 18, 21, 24
SHARE = 27
ADJOINT_RECORD = 28
# slots after the records: running sums
SUM, OUTER, CHANGED = 0, 3, 12
SUM_SLOTS = 13
ROUNDS = 60
CONVERGED = 1e-12  # m/rad, change of a derivative in one round
_L = LANES


@njit(**FAST)
def _moment_rate(w, u, s, record, load):  # type: ignore[no-untyped-def]
    """Write the derivative of the moment of the loads beyond by a rotation about a record's origin.

    K' of K t = sum (t x d) x f, from the sum of r f' at ``OUTER``; ``load``: the record whose
    total is the force.
    """
    a, b, c = record * RECORD * _L, load * RECORD * _L, record * ADJOINT_RECORD * _L
    for k in range(_L):
        trace = 0.0
        for i in range(3):
            o = w[U(a + (ORIGIN + i) * _L + k)] if record > 0 else 0.0
            trace += s[U((OUTER + 4 * i) * _L + k)] - o * w[U(b + (TOTAL + i) * _L + k)]
        for i in range(3):
            o = w[U(a + (ORIGIN + i) * _L + k)] if record > 0 else 0.0
            for j in range(3):
                outer = s[U((OUTER + 3 * i + j) * _L + k)] - o * w[U(b + (TOTAL + j) * _L + k)]
                u[U(c + (MOMENT_RATE + 3 * j + i) * _L + k)] = outer - (trace if i == j else 0.0)


@njit(**FAST)
def _hang(w, s, record, c, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Add a weight at ``c`` in a record's axes to the sum of r f'."""
    a = record * RECORD * _L
    cx, cy, cz = c[0], c[1], c[2]
    for k in range(_L):
        for i in range(3):
            r0, r1, r2 = three(w, a + (ROTATION + 3 * i) * _L, k)
            r = w[U(a + (ORIGIN + i) * _L + k)] + (r0 * cx + r1 * cy + r2 * cz)
            s[U((OUTER + 3 * i) * _L + k)] += r * fx
            s[U((OUTER + 3 * i + 1) * _L + k)] += r * fy
            s[U((OUTER + 3 * i + 2) * _L + k)] += r * fz


@njit(**FAST)
def _hang_tool(w, v, s, n, g):  # type: ignore[no-untyped-def]
    """Write the sum of r f' of pull and payload."""
    a = (n + 1) * RECORD * _L
    gx, gy, gz = g[0], g[1], g[2]
    for k in range(_L):
        m = v[U(MASS * _L + k)]
        wx, wy, wz = m * gx, m * gy, m * gz
        cx, cy, cz = three(v, COG * _L, k)
        fx, fy, fz = three(v, WRENCH * _L, k)
        for i in range(3):
            p = v[U((TCP + i) * _L + k)]
            r0, r1, r2 = three(w, a + (ROTATION + 3 * i) * _L, k)
            r = w[U(a + (ORIGIN + i) * _L + k)] + (r0 * cx + r1 * cy + r2 * cz)
            x, y, z = p * fx + r * wx, p * fy + r * wy, p * fz + r * wz
            put(s, (OUTER + 3 * i) * _L, k, x, y, z)


@njit(**FAST)
def _softness(w, u, record, compliance, softening):  # type: ignore[no-untyped-def]
    """Write a joint's moment in its own axes and what bending one more Nm makes."""
    a, b = record * RECORD * _L, record * ADJOINT_RECORD * _L
    c0, c1, c2 = compliance[0], compliance[1], compliance[2]
    for k in range(_L):
        mx, my, mz = three(w, a + MOMENT * _L, k)
        x, y, z = in_axes(w, a, k, mx, my, mz)
        put(u, b + BODY * _L, k, x, y, z)
        share = 1.0 / np.sqrt(1.0 + softening * z * z)
        u[U(b + SHARE * _L + k)] = share
        put(u, b + GIVE * _L, k, c0, c1, c2 * share * share * share)


@njit(**INNER)
def prepare(chain, w, v, u, s):  # type: ignore[no-untyped-def]
    """Write what all coordinates share, for lanes that have settled."""
    n, g = chain.mass.shape[0], chain.gravity
    _hang_tool(w, v, s, n, g)
    _moment_rate(w, u, s, n + 1, n + 1)
    for i in range(n - 1, -1, -1):
        m = chain.mass[i]
        _hang(w, s, i + 1, chain.cog[i], m * g[0], m * g[1], m * g[2])
        _moment_rate(w, u, s, i + 1, i + 1)
        _softness(w, u, i + 1, chain.compliance[i], chain.softening[i])
    _moment_rate(w, u, s, 0, 1)
    for j in range(3):
        for k in range(_L):
            u[(GIVE + j) * _L + k] = chain.base_compliance[j]
            u[(BODY + j) * _L + k] = w[RECORD * _L + (TOTAL + 3 + j) * _L + k]


@njit(**FAST)
def _out(w, v, u, s, record, axis, turning):  # type: ignore[no-untyped-def]
    """Write the derivatives by twists at a record, as far as the joints before it see them.

    ``axis`` of the coordinate, ``turning`` whether it is a rotation. Then add the record's own
    push to the sum.
    """
    a, b = record * RECORD * _L, record * ADJOINT_RECORD * _L
    # unit vector of the coordinate: for positions the force of the virtual work, else its moment
    ex, ey = 1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0
    ez = 1.0 if axis == 2 else 0.0
    moved, turned = 0.0 if turning else 1.0, 1.0 if turning else 0.0
    for k in range(_L):
        px, py, pz = three(s, SUM * _L, k)
        fx, fy, fz = three(w, a + TOTAL * _L, k)
        x, y, z = moved * ex + fy * pz, moved * ey + fz * px, moved * ez + fx * py
        put(u, b + SHIFT * _L, k, x - fz * py, y - fx * pz, z - fy * px)
        ox, oy, oz = three(w, a + ORIGIN * _L, k)
        x, y, z = three(v, TCP * _L, k)
        x, y, z = x - ox, y - oy, z - oz
        tx = turned * ex + moved * (y * ez - z * ey)
        ty = turned * ey + moved * (z * ex - x * ez)
        tz = turned * ez + moved * (x * ey - y * ex)
        put(u, b + TWIST * _L, k, tx, ty, tz)
        for j in range(3):
            m0, m1, m2 = three(u, b + (MOMENT_RATE + 3 * j) * _L, k)
            u[U(b + (TWIST + j) * _L + k)] += m0 * px + m1 * py + m2 * pz
            s[U((SUM + j) * _L + k)] += u[U(b + (REACTION + j) * _L + k)]


@njit(**FAST)
def _back(w, u, s, record):  # type: ignore[no-untyped-def]
    """Add what the joints from a record on see of a twist there; the sum goes with it."""
    a, b = record * RECORD * _L, record * ADJOINT_RECORD * _L
    turns = 1.0 if record > 0 else 0.0  # the base's moment counts about axes that do not turn
    for k in range(_L):
        px, py, pz = three(u, b + REACTION * _L, k)
        mx, my, mz = three(w, a + MOMENT * _L, k)
        mx, my, mz = turns * mx, turns * my, turns * mz
        for j in range(3):
            m0, m1, m2 = three(u, b + (MOMENT_RATE + 3 * j) * _L, k)
            s[U((SUM + j) * _L + k)] += m0 * px + m1 * py + m2 * pz
        s[U(SUM * _L + k)] -= my * pz - mz * py
        s[U((SUM + 1) * _L + k)] -= mz * px - mx * pz
        s[U((SUM + 2) * _L + k)] -= mx * py - my * px
        for j in range(3):
            u[U(b + (TWIST + j) * _L + k)] += s[U((SUM + j) * _L + k)]


@njit(**FAST)
def _adjoint(w, u, s, record):  # type: ignore[no-untyped-def]
    """Write a record's adjoint (by its bending, own axes), its reaction (by its moment, base axes).

    The turn that a changed bending makes is its right Jacobian (series as in ``turn_joint``).
    """
    a, b = record * RECORD * _L, record * ADJOINT_RECORD * _L
    for k in range(_L):
        x, y, z = three(u, b + TWIST * _L, k)
        tx, ty, tz = in_axes(w, a, k, x, y, z)
        x, y, z = three(w, a + BEND * _L, k)
        q = x * x + y * y + z * z
        second = 0.5 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0 * (
            1.0 - q / 90.0 * (1.0 - q / 132.0)))))  # fmt: skip
        third = (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0 * (
            1.0 - q / 110.0 * (1.0 - q / 156.0))))) / 6.0  # fmt: skip
        cx, cy, cz = y * tz - z * ty, z * tx - x * tz, x * ty - y * tx
        px = tx + second * cx + third * (y * cz - z * cy)
        py = ty + second * cy + third * (z * cx - x * cz)
        pz = tz + second * cz + third * (x * cy - y * cx)
        change_to(s, CHANGED * _L, u, b + ADJOINT * _L, k, (px, py, pz))
        put(u, b + ADJOINT * _L, k, px, py, pz)
        gx, gy, gz = three(u, b + GIVE * _L, k)
        px, py, pz = px * gx, py * gy, pz * gz
        if record > 0:
            for j in range(3):
                r0, r1, r2 = three(w, a + (ROTATION + 3 * j) * _L, k)
                u[U(b + (REACTION + j) * _L + k)] = r0 * px + r1 * py + r2 * pz
        else:
            put(u, b + REACTION * _L, k, px, py, pz)


@njit(**INNER)
def solve(lanes, axis, turning, deflected, converged):  # type: ignore[no-untyped-def]
    """Write the derivatives of one coordinate by twists, and adjoints; whether they converged."""
    w, v, u, s = lanes
    n = u.shape[0] // (ADJOINT_RECORD * _L) - 2
    for record in range(n + 2):
        a = record * ADJOINT_RECORD * _L
        for k in range(ADJOINT * _L, SHIFT * _L):
            u[a + k] = 0.0
    for _ in range(ROUNDS if deflected else 1):
        for k in range(_L):
            s[CHANGED * _L + k] = 0.0
            for j in range(3):
                s[(SUM + j) * _L + k] = u[(REACTION + j) * _L + k]
        for record in range(1, n + 2):
            _out(w, v, u, s, record, axis, turning)
        _base(v, u, axis, turning)
        for k in range(3 * _L):
            s[SUM * _L + k] = 0.0
        for record in range(n, -1, -1):
            _back(w, u, s, record)
        for record in range(n + 1):
            _adjoint(w, u, s, record)
        change = 0.0
        for k in range(_L):
            change = max(change, s[CHANGED * _L + k])
        if change < converged:
            return True
    return not deflected


@njit(**INNER)
def _base(v, u, axis, turning):  # type: ignore[no-untyped-def]
    """Write the derivative by a turn of everything about the base's origin."""
    e, f = (axis + 1) % 3, (axis + 2) % 3
    for k in range(_L):
        u[(TWIST + axis) * _L + k] = 1.0 if turning else 0.0
        u[(TWIST + e) * _L + k] = 0.0 if turning else v[(TCP + f) * _L + k]
        u[(TWIST + f) * _L + k] = 0.0 if turning else -v[(TCP + e) * _L + k]
