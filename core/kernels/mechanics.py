"""One joint of a block of rows: placed, bent, loaded; each loop is straight arithmetic over lanes.

That is what a compiler turns into vector instructions by itself. Sines come from polynomials for
the same reason.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.layout import (
    ANGLE,
    AXIS,
    BEND,
    CHANGE,
    COG,
    COSINE,
    FAST,
    LANES,
    LINK_SCALE,
    MASS,
    MOMENT,
    ORIGIN,
    RECORD,
    ROTATION,
    SINE,
    TCP,
    TCP_ROTATION,
    TOTAL,
    WRENCH,
    U,
)

_ROUND = 6755399441055744.0  # 1.5 * 2**52: adding and subtracting it rounds to whole numbers
_QUARTER_1, _QUARTER_2, _QUARTER_3 = (
    1.5707963267341256,
    6.077100506303966e-11,
    2.0222662487959506e-21,
)
_TWO_BY_PI = 0.6366197723675814


@njit(inline="always", **FAST)
def three(w, slot, k):  # type: ignore[no-untyped-def]
    """Return three numbers of lane k; the first of their slots begins at ``slot``."""
    return w[U(slot + k)], w[U(slot + LANES + k)], w[U(slot + 2 * LANES + k)]


@njit(inline="always", **FAST)
def put(w, slot, k, x, y, z):  # type: ignore[no-untyped-def]
    """Write what ``three`` returns."""
    w[U(slot + k)] = x
    w[U(slot + LANES + k)] = y
    w[U(slot + 2 * LANES + k)] = z


@njit(inline="always", **FAST)
def point_of(w, a, k, x, y, z):  # type: ignore[no-untyped-def]
    """Return where a point in the axes of the record that begins at ``a`` is, base axes."""
    r00, r01, r02 = three(w, a + ROTATION * LANES, k)
    r10, r11, r12 = three(w, a + (ROTATION + 3) * LANES, k)
    r20, r21, r22 = three(w, a + (ROTATION + 6) * LANES, k)
    ox, oy, oz = three(w, a + ORIGIN * LANES, k)
    return (
        ox + (r00 * x + r01 * y + r02 * z),
        oy + (r10 * x + r11 * y + r12 * z),
        oz + (r20 * x + r21 * y + r22 * z),
    )


@njit(inline="always", **FAST)
def in_axes(w, a, k, x, y, z):  # type: ignore[no-untyped-def]
    """Return a vector in base axes in those of the record that begins at ``a``."""
    r00, r01, r02 = three(w, a + ROTATION * LANES, k)
    r10, r11, r12 = three(w, a + (ROTATION + 3) * LANES, k)
    r20, r21, r22 = three(w, a + (ROTATION + 6) * LANES, k)
    return (
        r00 * x + (r10 * y + r20 * z),
        r01 * x + (r11 * y + r21 * z),
        r02 * x + (r12 * y + r22 * z),
    )


@njit(inline="always", **FAST)
def change_to(v, change, w, slot, k, new):  # type: ignore[no-untyped-def]
    """Keep at ``change`` of v how far three numbers change at most as they become ``new``."""
    x, y, z = three(w, slot, k)
    most = v[U(change + k)]
    d = abs(new[0] - x)
    most = d if d > most else most
    d = abs(new[1] - y)
    most = d if d > most else most
    d = abs(new[2] - z)
    v[U(change + k)] = d if d > most else most


@njit(**FAST)
def sines(w, record):  # type: ignore[no-untyped-def]
    """Write sine and cosine of a record's angle.

    Reduced to an eighth turn either side (Cody, Waite 1980), then the minimax polynomials of
    fdlibm's kernels (Sun Microsystems 1993): within 1 ulp.
    """
    a = record * RECORD * LANES
    for k in range(LANES):
        x = w[U(a + ANGLE * LANES + k)]
        turns = (x * _TWO_BY_PI + _ROUND) - _ROUND
        r = ((x - turns * _QUARTER_1) - turns * _QUARTER_2) - turns * _QUARTER_3
        z = r * r
        s = r + r * z * (
            -1.66666666666666324348e-01 + z * (8.33333333332248946124e-03
            + z * (-1.98412698298579493134e-04 + z * (2.75573137070700676789e-06
            + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10))))
        )  # fmt: skip
        c = 1.0 - 0.5 * z + z * z * (
            4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03
            + z * (2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07
            + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11))))
        )  # fmt: skip
        left = turns - 4.0 * ((turns * 0.25 + _ROUND) - _ROUND)  # -2..2: quarter turns
        odd = abs(left) == 1.0
        sine = c if odd else s
        cosine = s if odd else c
        w[U(a + SINE * LANES + k)] = -sine if (abs(left) == 2.0 or left == -1.0) else sine
        w[U(a + COSINE * LANES + k)] = -cosine if (abs(left) == 2.0 or left == 1.0) else cosine


@njit(**FAST)
def place_joint(w, i, R, p):  # type: ignore[no-untyped-def]
    """Place joint i (from 0) before its bending: record i+1 from record i."""
    a = i * RECORD * LANES
    b = a + RECORD * LANES
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    px, py, pz = p[0], p[1], p[2]
    for k in range(LANES):
        g = w[U(a + LINK_SCALE * LANES + k)]
        x, y, z = g * px, g * py, g * pz
        c, s = w[U(b + COSINE * LANES + k)], w[U(b + SINE * LANES + k)]
        for row in range(3):
            a0, a1, a2 = three(w, a + (ROTATION + 3 * row) * LANES, k)
            o = w[U(a + (ORIGIN + row) * LANES + k)]
            w[U(b + (ORIGIN + row) * LANES + k)] = o + a0 * x + a1 * y + a2 * z
            bx = a0 * r00 + a1 * r10 + a2 * r20
            by = a0 * r01 + a1 * r11 + a2 * r21
            bz = a0 * r02 + a1 * r12 + a2 * r22
            put(w, b + (ROTATION + 3 * row) * LANES, k, c * bx + s * by, c * by - s * bx, bz)
            w[U(b + (AXIS + row) * LANES + k)] = bz


@njit(**FAST)
def turn_joint(w, record):  # type: ignore[no-untyped-def]
    """Turn a record by its bending (exact finite rotation; series up to MAX_BEND_SQUARE)."""
    b = record * RECORD * LANES
    for k in range(LANES):
        x, y, z = three(w, b + BEND * LANES, k)
        q = x * x + y * y + z * z
        first = 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0 * (
            1.0 - q / 110.0 * (1.0 - q / 156.0)))))  # fmt: skip
        second = 0.5 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0 * (
            1.0 - q / 90.0 * (1.0 - q / 132.0 * (1.0 - q / 182.0))))))  # fmt: skip
        t00, t11, t22 = (
            1.0 - second * (y * y + z * z),
            1.0 - second * (x * x + z * z),
            1.0 - second * (x * x + y * y),
        )
        t01, t10 = second * x * y - first * z, second * x * y + first * z
        t02, t20 = second * x * z + first * y, second * x * z - first * y
        t12, t21 = second * y * z - first * x, second * y * z + first * x
        for row in range(3):
            a0, a1, a2 = three(w, b + (ROTATION + 3 * row) * LANES, k)
            x = a0 * t00 + a1 * t10 + a2 * t20
            y = a0 * t01 + a1 * t11 + a2 * t21
            z = a0 * t02 + a1 * t12 + a2 * t22
            put(w, b + (ROTATION + 3 * row) * LANES, k, x, y, z)


@njit(**FAST)
def place_flange(w, v, n, chain):  # type: ignore[no-untyped-def]
    """Place the flange (record n+1) and the TCP."""
    a = n * RECORD * LANES
    b = a + RECORD * LANES
    R, p, T, t = chain.rotation[n], chain.position[n], chain.tool_rotation, chain.tool_position
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    t00, t01, t02 = T[0, 0], T[0, 1], T[0, 2]
    t10, t11, t12 = T[1, 0], T[1, 1], T[1, 2]
    t20, t21, t22 = T[2, 0], T[2, 1], T[2, 2]
    px, py, pz, tx, ty, tz = p[0], p[1], p[2], t[0], t[1], t[2]
    for k in range(LANES):
        g = w[U(a + LINK_SCALE * LANES + k)]
        x, y, z = g * px, g * py, g * pz
        for row in range(3):
            a0, a1, a2 = three(w, a + (ROTATION + 3 * row) * LANES, k)
            o = w[U(a + (ORIGIN + row) * LANES + k)] + a0 * x + a1 * y + a2 * z
            bx = a0 * r00 + a1 * r10 + a2 * r20
            by = a0 * r01 + a1 * r11 + a2 * r21
            bz = a0 * r02 + a1 * r12 + a2 * r22
            w[U(b + (ORIGIN + row) * LANES + k)] = o
            put(w, b + (ROTATION + 3 * row) * LANES, k, bx, by, bz)
            v[U((TCP + row) * LANES + k)] = o + bx * tx + by * ty + bz * tz
            x_axis = bx * t00 + by * t10 + bz * t20
            y_axis = bx * t01 + by * t11 + bz * t21
            z_axis = bx * t02 + by * t12 + bz * t22
            put(v, (TCP_ROTATION + 3 * row) * LANES, k, x_axis, y_axis, z_axis)


@njit(**FAST)
def load_flange(w, v, n, g):  # type: ignore[no-untyped-def]
    """Write force and moment about the base origin that pull and payload make at the flange."""
    b = (n + 1) * RECORD * LANES
    gx, gy, gz = g[0], g[1], g[2]
    for k in range(LANES):
        px, py, pz = three(v, TCP * LANES, k)
        fx, fy, fz = three(v, WRENCH * LANES, k)
        tx, ty, tz = three(v, (WRENCH + 3) * LANES, k)
        m = v[U(MASS * LANES + k)]
        cx, cy, cz = three(v, COG * LANES, k)
        x, y, z = point_of(w, b, k, cx, cy, cz)
        wx, wy, wz = m * gx, m * gy, m * gz
        put(w, b + TOTAL * LANES, k, fx + wx, fy + wy, fz + wz)
        mx = tx + (py * fz - pz * fy) + (y * wz - z * wy)
        my = ty + (pz * fx - px * fz) + (z * wx - x * wz)
        mz = tz + (px * fy - py * fx) + (x * wy - y * wx)
        put(w, b + (TOTAL + 3) * LANES, k, mx, my, mz)
        v[U(CHANGE * LANES + k)] = 0.0


@njit(**FAST)
def load_joint(w, i, m, c, g):  # type: ignore[no-untyped-def]
    """Add link i's weight (m at c) to what comes from beyond; write the joint's moment."""
    b = (i + 1) * RECORD * LANES
    a = b + RECORD * LANES
    cx, cy, cz = c[0], c[1], c[2]
    wx, wy, wz = m * g[0], m * g[1], m * g[2]
    for k in range(LANES):
        ox, oy, oz = three(w, b + ORIGIN * LANES, k)
        x, y, z = point_of(w, b, k, cx, cy, cz)
        fx, fy, fz = three(w, a + TOTAL * LANES, k)
        fx, fy, fz = fx + wx, fy + wy, fz + wz
        mx, my, mz = three(w, a + (TOTAL + 3) * LANES, k)
        mx += y * wz - z * wy
        my += z * wx - x * wz
        mz += x * wy - y * wx
        put(w, b + TOTAL * LANES, k, fx, fy, fz)
        put(w, b + (TOTAL + 3) * LANES, k, mx, my, mz)
        mx, my, mz = mx - (oy * fz - oz * fy), my - (oz * fx - ox * fz), mz - (ox * fy - oy * fx)
        put(w, b + MOMENT * LANES, k, mx, my, mz)


@njit(**FAST)
def bend_joint(w, v, record, compliance, softening):  # type: ignore[no-untyped-def]
    """Write the bending that a record's moment makes, and how far it has changed at most."""
    b = record * RECORD * LANES
    c0, c1, c2 = compliance[0], compliance[1], compliance[2]
    for k in range(LANES):
        mx, my, mz = three(w, b + MOMENT * LANES, k)
        x, y, z = in_axes(w, b, k, mx, my, mz)
        x, y = c0 * x, c1 * y
        z = c2 * z / np.sqrt(1.0 + softening * z * z)
        change_to(v, CHANGE * LANES, w, b + BEND * LANES, k, (x, y, z))
        put(w, b + BEND * LANES, k, x, y, z)


@njit(**FAST)
def bend_base(w, v, compliance):  # type: ignore[no-untyped-def]
    """Write the base's rotation and turn record 0 by it."""
    c = RECORD * LANES
    for axis in range(3):
        for k in range(LANES):
            base_rotation = compliance[axis] * w[U(c + (TOTAL + 3 + axis) * LANES + k)]
            d = abs(base_rotation - w[U((BEND + axis) * LANES + k)])
            change = v[U(CHANGE * LANES + k)]
            v[U(CHANGE * LANES + k)] = d if d > change else change
            w[U((BEND + axis) * LANES + k)] = base_rotation
