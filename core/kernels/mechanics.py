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
    GROWTH,
    LANES,
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
        g = w[U(a + GROWTH * LANES + k)]
        x, y, z = g * px, g * py, g * pz
        c, s = w[U(b + COSINE * LANES + k)], w[U(b + SINE * LANES + k)]
        for row in range(3):
            a0 = w[U(a + (ROTATION + 3 * row) * LANES + k)]
            a1 = w[U(a + (ROTATION + 3 * row + 1) * LANES + k)]
            a2 = w[U(a + (ROTATION + 3 * row + 2) * LANES + k)]
            o = w[U(a + (ORIGIN + row) * LANES + k)]
            w[U(b + (ORIGIN + row) * LANES + k)] = o + a0 * x + a1 * y + a2 * z
            bx = a0 * r00 + a1 * r10 + a2 * r20
            by = a0 * r01 + a1 * r11 + a2 * r21
            bz = a0 * r02 + a1 * r12 + a2 * r22
            w[U(b + (ROTATION + 3 * row) * LANES + k)] = c * bx + s * by
            w[U(b + (ROTATION + 3 * row + 1) * LANES + k)] = c * by - s * bx
            w[U(b + (ROTATION + 3 * row + 2) * LANES + k)] = bz
            w[U(b + (AXIS + row) * LANES + k)] = bz


@njit(**FAST)
def turn_joint(w, record):  # type: ignore[no-untyped-def]
    """Turn a record by its bending (exact finite rotation; series up to STEEPEST)."""
    b = record * RECORD * LANES
    for k in range(LANES):
        x = w[U(b + BEND * LANES + k)]
        y = w[U(b + (BEND + 1) * LANES + k)]
        z = w[U(b + (BEND + 2) * LANES + k)]
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
            a0 = w[U(b + (ROTATION + 3 * row) * LANES + k)]
            a1 = w[U(b + (ROTATION + 3 * row + 1) * LANES + k)]
            a2 = w[U(b + (ROTATION + 3 * row + 2) * LANES + k)]
            w[U(b + (ROTATION + 3 * row) * LANES + k)] = a0 * t00 + a1 * t10 + a2 * t20
            w[U(b + (ROTATION + 3 * row + 1) * LANES + k)] = a0 * t01 + a1 * t11 + a2 * t21
            w[U(b + (ROTATION + 3 * row + 2) * LANES + k)] = a0 * t02 + a1 * t12 + a2 * t22


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
        g = w[U(a + GROWTH * LANES + k)]
        x, y, z = g * px, g * py, g * pz
        for row in range(3):
            a0 = w[U(a + (ROTATION + 3 * row) * LANES + k)]
            a1 = w[U(a + (ROTATION + 3 * row + 1) * LANES + k)]
            a2 = w[U(a + (ROTATION + 3 * row + 2) * LANES + k)]
            o = w[U(a + (ORIGIN + row) * LANES + k)] + a0 * x + a1 * y + a2 * z
            bx = a0 * r00 + a1 * r10 + a2 * r20
            by = a0 * r01 + a1 * r11 + a2 * r21
            bz = a0 * r02 + a1 * r12 + a2 * r22
            w[U(b + (ORIGIN + row) * LANES + k)] = o
            w[U(b + (ROTATION + 3 * row) * LANES + k)] = bx
            w[U(b + (ROTATION + 3 * row + 1) * LANES + k)] = by
            w[U(b + (ROTATION + 3 * row + 2) * LANES + k)] = bz
            v[U((TCP + row) * LANES + k)] = o + bx * tx + by * ty + bz * tz
            v[U((TCP_ROTATION + 3 * row) * LANES + k)] = bx * t00 + by * t10 + bz * t20
            v[U((TCP_ROTATION + 3 * row + 1) * LANES + k)] = bx * t01 + by * t11 + bz * t21
            v[U((TCP_ROTATION + 3 * row + 2) * LANES + k)] = bx * t02 + by * t12 + bz * t22


@njit(**FAST)
def load_flange(w, v, n, g):  # type: ignore[no-untyped-def]
    """Write force and moment about the base origin that pull and payload make at the flange."""
    b = (n + 1) * RECORD * LANES
    gx, gy, gz = g[0], g[1], g[2]
    for k in range(LANES):
        px, py, pz = v[U(TCP * LANES + k)], v[U((TCP + 1) * LANES + k)], v[U((TCP + 2) * LANES + k)]
        fx, fy = v[U(WRENCH * LANES + k)], v[U((WRENCH + 1) * LANES + k)]
        fz = v[U((WRENCH + 2) * LANES + k)]
        m = v[U(MASS * LANES + k)]
        cx, cy = v[U(COG * LANES + k)], v[U((COG + 1) * LANES + k)]
        cz = v[U((COG + 2) * LANES + k)]
        x = w[U(b + ORIGIN * LANES + k)] + (
            w[U(b + ROTATION * LANES + k)] * cx + w[U(b + (ROTATION + 1) * LANES + k)] * cy
            + w[U(b + (ROTATION + 2) * LANES + k)] * cz
        )  # fmt: skip
        y = w[U(b + (ORIGIN + 1) * LANES + k)] + (
            w[U(b + (ROTATION + 3) * LANES + k)] * cx + w[U(b + (ROTATION + 4) * LANES + k)] * cy
            + w[U(b + (ROTATION + 5) * LANES + k)] * cz
        )  # fmt: skip
        z = w[U(b + (ORIGIN + 2) * LANES + k)] + (
            w[U(b + (ROTATION + 6) * LANES + k)] * cx + w[U(b + (ROTATION + 7) * LANES + k)] * cy
            + w[U(b + (ROTATION + 8) * LANES + k)] * cz
        )  # fmt: skip
        wx, wy, wz = m * gx, m * gy, m * gz
        w[U(b + TOTAL * LANES + k)] = fx + wx
        w[U(b + (TOTAL + 1) * LANES + k)] = fy + wy
        w[U(b + (TOTAL + 2) * LANES + k)] = fz + wz
        w[U(b + (TOTAL + 3) * LANES + k)] = (
            v[U((WRENCH + 3) * LANES + k)] + (py * fz - pz * fy) + (y * wz - z * wy)
        )
        w[U(b + (TOTAL + 4) * LANES + k)] = (
            v[U((WRENCH + 4) * LANES + k)] + (pz * fx - px * fz) + (z * wx - x * wz)
        )
        w[U(b + (TOTAL + 5) * LANES + k)] = (
            v[U((WRENCH + 5) * LANES + k)] + (px * fy - py * fx) + (x * wy - y * wx)
        )
        v[U(CHANGE * LANES + k)] = 0.0


@njit(**FAST)
def load_joint(w, i, m, c, g):  # type: ignore[no-untyped-def]
    """Add link i's weight (m at c) to what comes from beyond; write the joint's moment."""
    b = (i + 1) * RECORD * LANES
    a = b + RECORD * LANES
    cx, cy, cz = c[0], c[1], c[2]
    wx, wy, wz = m * g[0], m * g[1], m * g[2]
    for k in range(LANES):
        ox, oy = w[U(b + ORIGIN * LANES + k)], w[U(b + (ORIGIN + 1) * LANES + k)]
        oz = w[U(b + (ORIGIN + 2) * LANES + k)]
        x = ox + (
            w[U(b + ROTATION * LANES + k)] * cx + w[U(b + (ROTATION + 1) * LANES + k)] * cy
            + w[U(b + (ROTATION + 2) * LANES + k)] * cz
        )  # fmt: skip
        y = oy + (
            w[U(b + (ROTATION + 3) * LANES + k)] * cx + w[U(b + (ROTATION + 4) * LANES + k)] * cy
            + w[U(b + (ROTATION + 5) * LANES + k)] * cz
        )  # fmt: skip
        z = oz + (
            w[U(b + (ROTATION + 6) * LANES + k)] * cx + w[U(b + (ROTATION + 7) * LANES + k)] * cy
            + w[U(b + (ROTATION + 8) * LANES + k)] * cz
        )  # fmt: skip
        fx = w[U(a + TOTAL * LANES + k)] + wx
        fy = w[U(a + (TOTAL + 1) * LANES + k)] + wy
        fz = w[U(a + (TOTAL + 2) * LANES + k)] + wz
        mx = w[U(a + (TOTAL + 3) * LANES + k)] + (y * wz - z * wy)
        my = w[U(a + (TOTAL + 4) * LANES + k)] + (z * wx - x * wz)
        mz = w[U(a + (TOTAL + 5) * LANES + k)] + (x * wy - y * wx)
        w[U(b + TOTAL * LANES + k)] = fx
        w[U(b + (TOTAL + 1) * LANES + k)] = fy
        w[U(b + (TOTAL + 2) * LANES + k)] = fz
        w[U(b + (TOTAL + 3) * LANES + k)] = mx
        w[U(b + (TOTAL + 4) * LANES + k)] = my
        w[U(b + (TOTAL + 5) * LANES + k)] = mz
        w[U(b + MOMENT * LANES + k)] = mx - (oy * fz - oz * fy)
        w[U(b + (MOMENT + 1) * LANES + k)] = my - (oz * fx - ox * fz)
        w[U(b + (MOMENT + 2) * LANES + k)] = mz - (ox * fy - oy * fx)


@njit(**FAST)
def bend_joint(w, v, record, compliance, softening):  # type: ignore[no-untyped-def]
    """Write the bending that a record's moment makes, and how far it has changed at most."""
    b = record * RECORD * LANES
    c0, c1, c2 = compliance[0], compliance[1], compliance[2]
    for k in range(LANES):
        mx, my = w[U(b + MOMENT * LANES + k)], w[U(b + (MOMENT + 1) * LANES + k)]
        mz = w[U(b + (MOMENT + 2) * LANES + k)]
        x = w[U(b + ROTATION * LANES + k)] * mx + (
            w[U(b + (ROTATION + 3) * LANES + k)] * my + w[U(b + (ROTATION + 6) * LANES + k)] * mz
        )
        y = w[U(b + (ROTATION + 1) * LANES + k)] * mx + (
            w[U(b + (ROTATION + 4) * LANES + k)] * my + w[U(b + (ROTATION + 7) * LANES + k)] * mz
        )
        z = w[U(b + (ROTATION + 2) * LANES + k)] * mx + (
            w[U(b + (ROTATION + 5) * LANES + k)] * my + w[U(b + (ROTATION + 8) * LANES + k)] * mz
        )
        x, y = c0 * x, c1 * y
        z = c2 * z / np.sqrt(1.0 + softening * z * z)
        change = v[U(CHANGE * LANES + k)]
        d = abs(x - w[U(b + BEND * LANES + k)])
        change = d if d > change else change
        d = abs(y - w[U(b + (BEND + 1) * LANES + k)])
        change = d if d > change else change
        d = abs(z - w[U(b + (BEND + 2) * LANES + k)])
        v[U(CHANGE * LANES + k)] = d if d > change else change
        w[U(b + BEND * LANES + k)] = x
        w[U(b + (BEND + 1) * LANES + k)] = y
        w[U(b + (BEND + 2) * LANES + k)] = z


@njit(**FAST)
def bend_base(w, v, compliance):  # type: ignore[no-untyped-def]
    """Write the base's tilt and turn record 0 by it."""
    c = RECORD * LANES
    for axis in range(3):
        for k in range(LANES):
            base_rotation = compliance[axis] * w[U(c + (TOTAL + 3 + axis) * LANES + k)]
            d = abs(base_rotation - w[U((BEND + axis) * LANES + k)])
            change = v[U(CHANGE * LANES + k)]
            v[U(CHANGE * LANES + k)] = d if d > change else change
            w[U((BEND + axis) * LANES + k)] = base_rotation
