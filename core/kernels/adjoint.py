"""How one coordinate of the TCP changes with everything in a bending chain: exact, by adjoints.

The bending x of all joints is what their moments make of it: x = C M(x, p). The coordinate y(x, p)
then changes by dy/dp = y_p + a C M_p with a = y_x + a C M_x, which is solved by iteration (it
contracts as fast as the equilibrium itself). All perturbations are twists of everything beyond a
place of the chain, so that one sweep out and one back give the derivatives for every place.
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
from gapbridge.core.kernels.reference import INNER

# slots of a record of this workspace; records as in layout
MOMENT_RATE, GIVE, BODY, PULL, PUSH, SHIFT, TWIST = 0, 9, 12, 15, 18, 21, 24
SHARE = 27
OWN = 28
# slots beside the records: sums on the way
SUM, OUTER, CHANGED = 0, 3, 12
BESIDE = 13
ROUNDS = 60
CONVERGED = 1e-12  # of m/rad: the next round would change a thousandth of it
_L = LANES


@njit(**FAST)
def _moment_rate(w, u, s, record, load):  # type: ignore[no-untyped-def]
    """Write by how much the moment of the loads beyond changes per turn about a record's origin.

    K' of K t = sum (t x d) x f, from the sum of r f' at ``OUTER``; ``load``: the record whose
    total is the force.
    """
    a, b, c = record * RECORD * _L, load * RECORD * _L, record * OWN * _L
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
            r = w[U(a + (ORIGIN + i) * _L + k)] + (
                w[U(a + (ROTATION + 3 * i) * _L + k)] * cx
                + w[U(a + (ROTATION + 3 * i + 1) * _L + k)] * cy
                + w[U(a + (ROTATION + 3 * i + 2) * _L + k)] * cz
            )
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
        cx, cy, cz = v[U(COG * _L + k)], v[U((COG + 1) * _L + k)], v[U((COG + 2) * _L + k)]
        fx, fy = v[U(WRENCH * _L + k)], v[U((WRENCH + 1) * _L + k)]
        fz = v[U((WRENCH + 2) * _L + k)]
        for i in range(3):
            p = v[U((TCP + i) * _L + k)]
            r = w[U(a + (ORIGIN + i) * _L + k)] + (
                w[U(a + (ROTATION + 3 * i) * _L + k)] * cx
                + w[U(a + (ROTATION + 3 * i + 1) * _L + k)] * cy
                + w[U(a + (ROTATION + 3 * i + 2) * _L + k)] * cz
            )
            s[U((OUTER + 3 * i) * _L + k)] = p * fx + r * wx
            s[U((OUTER + 3 * i + 1) * _L + k)] = p * fy + r * wy
            s[U((OUTER + 3 * i + 2) * _L + k)] = p * fz + r * wz


@njit(**FAST)
def _softness(w, u, record, compliance, softening):  # type: ignore[no-untyped-def]
    """Write a joint's moment in its own axes and what bending one more Nm makes."""
    a, b = record * RECORD * _L, record * OWN * _L
    c0, c1, c2 = compliance[0], compliance[1], compliance[2]
    for k in range(_L):
        mx, my = w[U(a + MOMENT * _L + k)], w[U(a + (MOMENT + 1) * _L + k)]
        mz = w[U(a + (MOMENT + 2) * _L + k)]
        for j in range(3):
            u[U(b + (BODY + j) * _L + k)] = w[U(a + (ROTATION + j) * _L + k)] * mx + (
                w[U(a + (ROTATION + 3 + j) * _L + k)] * my
                + w[U(a + (ROTATION + 6 + j) * _L + k)] * mz
            )
        z = u[U(b + (BODY + 2) * _L + k)]
        share = 1.0 / np.sqrt(1.0 + softening * z * z)
        u[U(b + SHARE * _L + k)] = share
        u[U(b + GIVE * _L + k)] = c0
        u[U(b + (GIVE + 1) * _L + k)] = c1
        u[U(b + (GIVE + 2) * _L + k)] = c2 * share * share * share


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
    a, b = record * RECORD * _L, record * OWN * _L
    # unit vector of the coordinate: for positions the force of the virtual work, else its moment
    ex, ey = 1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0
    ez = 1.0 if axis == 2 else 0.0
    moved, turned = 0.0 if turning else 1.0, 1.0 if turning else 0.0
    for k in range(_L):
        px, py, pz = s[U(SUM * _L + k)], s[U((SUM + 1) * _L + k)], s[U((SUM + 2) * _L + k)]
        fx, fy = w[U(a + TOTAL * _L + k)], w[U(a + (TOTAL + 1) * _L + k)]
        fz = w[U(a + (TOTAL + 2) * _L + k)]
        u[U(b + SHIFT * _L + k)] = moved * ex + fy * pz - fz * py
        u[U(b + (SHIFT + 1) * _L + k)] = moved * ey + fz * px - fx * pz
        u[U(b + (SHIFT + 2) * _L + k)] = moved * ez + fx * py - fy * px
        x = v[U(TCP * _L + k)] - w[U(a + ORIGIN * _L + k)]
        y = v[U((TCP + 1) * _L + k)] - w[U(a + (ORIGIN + 1) * _L + k)]
        z = v[U((TCP + 2) * _L + k)] - w[U(a + (ORIGIN + 2) * _L + k)]
        u[U(b + TWIST * _L + k)] = turned * ex + moved * (y * ez - z * ey)
        u[U(b + (TWIST + 1) * _L + k)] = turned * ey + moved * (z * ex - x * ez)
        u[U(b + (TWIST + 2) * _L + k)] = turned * ez + moved * (x * ey - y * ex)
        for j in range(3):
            u[U(b + (TWIST + j) * _L + k)] += (
                u[U(b + (MOMENT_RATE + 3 * j) * _L + k)] * px
                + u[U(b + (MOMENT_RATE + 3 * j + 1) * _L + k)] * py
                + u[U(b + (MOMENT_RATE + 3 * j + 2) * _L + k)] * pz
            )
            s[U((SUM + j) * _L + k)] += u[U(b + (PUSH + j) * _L + k)]


@njit(**FAST)
def _back(w, u, s, record):  # type: ignore[no-untyped-def]
    """Add what the joints from a record on see of a twist there; the sum goes with it."""
    a, b = record * RECORD * _L, record * OWN * _L
    turns = 1.0 if record > 0 else 0.0  # the base's moment counts about axes that do not turn
    for k in range(_L):
        px, py = u[U(b + PUSH * _L + k)], u[U(b + (PUSH + 1) * _L + k)]
        pz = u[U(b + (PUSH + 2) * _L + k)]
        mx, my = turns * w[U(a + MOMENT * _L + k)], turns * w[U(a + (MOMENT + 1) * _L + k)]
        mz = turns * w[U(a + (MOMENT + 2) * _L + k)]
        for j in range(3):
            s[U((SUM + j) * _L + k)] += (
                u[U(b + (MOMENT_RATE + 3 * j) * _L + k)] * px
                + u[U(b + (MOMENT_RATE + 3 * j + 1) * _L + k)] * py
                + u[U(b + (MOMENT_RATE + 3 * j + 2) * _L + k)] * pz
            )
        s[U(SUM * _L + k)] -= my * pz - mz * py
        s[U((SUM + 1) * _L + k)] -= mz * px - mx * pz
        s[U((SUM + 2) * _L + k)] -= mx * py - my * px
        for j in range(3):
            u[U(b + (TWIST + j) * _L + k)] += s[U((SUM + j) * _L + k)]


@njit(**FAST)
def _pulled(w, u, s, record):  # type: ignore[no-untyped-def]
    """Write a record's adjoint (by its bending, own axes) and its push (by its moment, base axes).

    The turn that a changed bending makes is its right Jacobian (series as in ``turn_joint``).
    """
    a, b = record * RECORD * _L, record * OWN * _L
    for k in range(_L):
        gx, gy = u[U(b + TWIST * _L + k)], u[U(b + (TWIST + 1) * _L + k)]
        gz = u[U(b + (TWIST + 2) * _L + k)]
        x, y = w[U(a + BEND * _L + k)], w[U(a + (BEND + 1) * _L + k)]
        z = w[U(a + (BEND + 2) * _L + k)]
        r00, r01, r02 = (
            w[U(a + ROTATION * _L + k)], w[U(a + (ROTATION + 1) * _L + k)],
            w[U(a + (ROTATION + 2) * _L + k)],
        )  # fmt: skip
        r10, r11, r12 = (
            w[U(a + (ROTATION + 3) * _L + k)], w[U(a + (ROTATION + 4) * _L + k)],
            w[U(a + (ROTATION + 5) * _L + k)],
        )  # fmt: skip
        r20, r21, r22 = (
            w[U(a + (ROTATION + 6) * _L + k)], w[U(a + (ROTATION + 7) * _L + k)],
            w[U(a + (ROTATION + 8) * _L + k)],
        )  # fmt: skip
        tx = r00 * gx + r10 * gy + r20 * gz
        ty = r01 * gx + r11 * gy + r21 * gz
        tz = r02 * gx + r12 * gy + r22 * gz
        q = x * x + y * y + z * z
        second = 0.5 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0 * (
            1.0 - q / 90.0 * (1.0 - q / 132.0)))))  # fmt: skip
        third = (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0 * (
            1.0 - q / 110.0 * (1.0 - q / 156.0))))) / 6.0  # fmt: skip
        cx, cy, cz = y * tz - z * ty, z * tx - x * tz, x * ty - y * tx
        px = tx + second * cx + third * (y * cz - z * cy)
        py = ty + second * cy + third * (z * cx - x * cz)
        pz = tz + second * cz + third * (x * cy - y * cx)
        change = s[U(CHANGED * _L + k)]
        d = abs(px - u[U(b + PULL * _L + k)])
        change = d if d > change else change
        d = abs(py - u[U(b + (PULL + 1) * _L + k)])
        change = d if d > change else change
        d = abs(pz - u[U(b + (PULL + 2) * _L + k)])
        s[U(CHANGED * _L + k)] = d if d > change else change
        u[U(b + PULL * _L + k)] = px
        u[U(b + (PULL + 1) * _L + k)] = py
        u[U(b + (PULL + 2) * _L + k)] = pz
        px *= u[U(b + GIVE * _L + k)]
        py *= u[U(b + (GIVE + 1) * _L + k)]
        pz *= u[U(b + (GIVE + 2) * _L + k)]
        if record > 0:
            u[U(b + PUSH * _L + k)] = r00 * px + r01 * py + r02 * pz
            u[U(b + (PUSH + 1) * _L + k)] = r10 * px + r11 * py + r12 * pz
            u[U(b + (PUSH + 2) * _L + k)] = r20 * px + r21 * py + r22 * pz
        else:
            u[U(b + PUSH * _L + k)] = px
            u[U(b + (PUSH + 1) * _L + k)] = py
            u[U(b + (PUSH + 2) * _L + k)] = pz


@njit(**INNER)
def solve(w, v, u, s, n, axis, turning, deflected, converged):  # type: ignore[no-untyped-def]
    """Write the derivatives of one coordinate by twists, and the adjoints; whether it settled."""
    for record in range(n + 2):
        a = record * OWN * _L
        for k in range(PULL * _L, SHIFT * _L):
            u[a + k] = 0.0
    for _ in range(ROUNDS if deflected else 1):
        for k in range(_L):
            s[CHANGED * _L + k] = 0.0
            for j in range(3):
                s[(SUM + j) * _L + k] = u[(PUSH + j) * _L + k]
        for record in range(1, n + 2):
            _out(w, v, u, s, record, axis, turning)
        _base(v, u, axis, turning)
        for k in range(3 * _L):
            s[SUM * _L + k] = 0.0
        for record in range(n, -1, -1):
            _back(w, u, s, record)
        for record in range(n + 1):
            _pulled(w, u, s, record)
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
