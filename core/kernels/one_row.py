"""One row at a time for the loop: the exact equilibrium without a view or a buffer.

The same mechanics as reference.py, which stays the reference, for arms whose links are stiff. All
lives in one block per arm (packed.py: chain, row, then a workspace), reached by plain indices: in
core.kernels.reference most of a row's time goes into views of arrays, not into arithmetic.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.layout import FAST, U
from gapbridge.core.kernels.packed import sizes_of
from gapbridge.core.kernels.reference import MAX_ITERATIONS, TOLERANCE

# the workspace: a record per joint, the flange's record with the TCP, the Jacobian's columns
ROTATION, ORIGIN, AXIS, MOMENT, BEND = 0, 9, 12, 15, 18
RECORD = 21
TCP, TCP_ROTATION = 12, 15  # in the flange's record, of 24
FLANGE = 24


@njit(**FAST)
def turn(x, y, z):  # type: ignore[no-untyped-def]
    """Return the two factors of Rodrigues' formula for a rotation vector."""
    q = x * x + y * y + z * z
    if q < 1e-3:  # the series are exact to rounding here
        first = 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0)))
        second = 0.5 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0 * (1.0 - q / 90.0))))
        return first, second
    angle = np.sqrt(q)
    half = np.sin(0.5 * angle) / angle
    return np.sin(angle) / angle, 2.0 * half * half


@njit(**FAST)
def place(b, n, w, deflected, tx, ty, tz):  # type: ignore[no-untyped-def]
    """Place all frames of the block's row for the present bending and tilt of the base."""
    first, second = turn(tx, ty, tz)
    a00, a01, a02 = 1.0 - second * (ty * ty + tz * tz), second * tx * ty - first * tz, (
        second * tx * tz + first * ty)  # fmt: skip
    a10, a11, a12 = second * tx * ty + first * tz, 1.0 - second * (tx * tx + tz * tz), (
        second * ty * tz - first * tx)  # fmt: skip
    a20, a21, a22 = second * tx * tz - first * ty, second * ty * tz + first * tx, (
        1.0 - second * (tx * tx + ty * ty))  # fmt: skip
    ox = oy = oz = 0.0
    shift = 9 * (n + 1)  # from the rotations to the positions
    row = sizes_of(n)[0]
    for i in range(n + 1):
        g = b[U(row + n + i - 1)] if i > 0 else 1.0
        x, y, z = (
            g * b[U(shift + 3 * i)], g * b[U(shift + 3 * i + 1)], g * b[U(shift + 3 * i + 2)]
        )  # fmt: skip
        ox += a00 * x + a01 * y + a02 * z
        oy += a10 * x + a11 * y + a12 * z
        oz += a20 * x + a21 * y + a22 * z
        k = 9 * i
        r00, r01, r02 = b[U(k)], b[U(k + 1)], b[U(k + 2)]
        r10, r11, r12 = b[U(k + 3)], b[U(k + 4)], b[U(k + 5)]
        r20, r21, r22 = b[U(k + 6)], b[U(k + 7)], b[U(k + 8)]
        b00, b01, b02 = (
            a00 * r00 + a01 * r10 + a02 * r20, a00 * r01 + a01 * r11 + a02 * r21,
            a00 * r02 + a01 * r12 + a02 * r22,
        )  # fmt: skip
        b10, b11, b12 = (
            a10 * r00 + a11 * r10 + a12 * r20, a10 * r01 + a11 * r11 + a12 * r21,
            a10 * r02 + a11 * r12 + a12 * r22,
        )  # fmt: skip
        b20, b21, b22 = (
            a20 * r00 + a21 * r10 + a22 * r20, a20 * r01 + a21 * r11 + a22 * r21,
            a20 * r02 + a21 * r12 + a22 * r22,
        )  # fmt: skip
        j = w + RECORD * i
        if i < n:
            c, s = np.cos(b[U(row + i)]), np.sin(b[U(row + i)])
            b00, b01 = c * b00 + s * b01, c * b01 - s * b00
            b10, b11 = c * b10 + s * b11, c * b11 - s * b10
            b20, b21 = c * b20 + s * b21, c * b21 - s * b20
            b[U(j + AXIS)], b[U(j + AXIS + 1)], b[U(j + AXIS + 2)] = b02, b12, b22
        if deflected and i < n:
            x, y, z = b[U(j + BEND)], b[U(j + BEND + 1)], b[U(j + BEND + 2)]
            first, second = turn(x, y, z)
            t00, t11, t22 = (
                1.0 - second * (y * y + z * z), 1.0 - second * (x * x + z * z),
                1.0 - second * (x * x + y * y),
            )  # fmt: skip
            t01, t10 = second * x * y - first * z, second * x * y + first * z
            t02, t20 = second * x * z + first * y, second * x * z - first * y
            t12, t21 = second * y * z - first * x, second * y * z + first * x
            a00, a01, a02 = (
                b00 * t00 + b01 * t10 + b02 * t20, b00 * t01 + b01 * t11 + b02 * t21,
                b00 * t02 + b01 * t12 + b02 * t22,
            )  # fmt: skip
            a10, a11, a12 = (
                b10 * t00 + b11 * t10 + b12 * t20, b10 * t01 + b11 * t11 + b12 * t21,
                b10 * t02 + b11 * t12 + b12 * t22,
            )  # fmt: skip
            a20, a21, a22 = (
                b20 * t00 + b21 * t10 + b22 * t20, b20 * t01 + b21 * t11 + b22 * t21,
                b20 * t02 + b21 * t12 + b22 * t22,
            )  # fmt: skip
        else:
            a00, a01, a02, a10, a11, a12 = b00, b01, b02, b10, b11, b12
            a20, a21, a22 = b20, b21, b22
        b[U(j)], b[U(j + 1)], b[U(j + 2)] = a00, a01, a02
        b[U(j + 3)], b[U(j + 4)], b[U(j + 5)] = a10, a11, a12
        b[U(j + 6)], b[U(j + 7)], b[U(j + 8)] = a20, a21, a22
        b[U(j + ORIGIN)], b[U(j + ORIGIN + 1)], b[U(j + ORIGIN + 2)] = ox, oy, oz
    t = 12 * (n + 1)  # the tool: rotation, position
    f = w + RECORD * n
    x, y, z = b[U(t + 9)], b[U(t + 10)], b[U(t + 11)]
    for k in range(3):
        e0, e1, e2 = b[U(f + 3 * k)], b[U(f + 3 * k + 1)], b[U(f + 3 * k + 2)]
        b[U(f + TCP + k)] = b[U(f + ORIGIN + k)] + e0 * x + e1 * y + e2 * z
        for m in range(3):
            b[U(f + TCP_ROTATION + 3 * k + m)] = (
                e0 * b[U(t + m)] + e1 * b[U(t + 3 + m)] + e2 * b[U(t + 6 + m)]
            )


@njit(**FAST)
def load(b, n, w):  # type: ignore[no-untyped-def]
    """Write the joints' moments and the bending that they make; returns how far it has changed.

    Besides the moment at the base's origin.
    """
    f, row = w + RECORD * n, sizes_of(n)[0]
    mass = 12 * (n + 1) + 12
    cog, gravity = mass + n, mass + 4 * n
    soft = gravity + 3  # the compliances (n, 3), then the softening (n,)
    held = row + 2 * n  # payload: mass, centre of gravity; then the pull
    gx, gy, gz = b[U(gravity)], b[U(gravity + 1)], b[U(gravity + 2)]
    fx, fy, fz = b[U(held + 4)], b[U(held + 5)], b[U(held + 6)]
    px, py, pz = b[U(f + TCP)], b[U(f + TCP + 1)], b[U(f + TCP + 2)]
    mx = b[U(held + 7)] + py * fz - pz * fy
    my = b[U(held + 8)] + pz * fx - px * fz
    mz = b[U(held + 9)] + px * fy - py * fx
    change = 0.0
    for i in range(n, -1, -1):
        j = w + RECORD * i
        m = b[U(mass + i)] if i < n else b[U(held)]
        at = cog + 3 * i if i < n else held + 1
        cx, cy, cz = b[U(at)], b[U(at + 1)], b[U(at + 2)]
        ox, oy, oz = b[U(j + ORIGIN)], b[U(j + ORIGIN + 1)], b[U(j + ORIGIN + 2)]
        r00, r01, r02 = b[U(j)], b[U(j + 1)], b[U(j + 2)]
        r10, r11, r12 = b[U(j + 3)], b[U(j + 4)], b[U(j + 5)]
        r20, r21, r22 = b[U(j + 6)], b[U(j + 7)], b[U(j + 8)]
        x = ox + r00 * cx + r01 * cy + r02 * cz
        y = oy + r10 * cx + r11 * cy + r12 * cz
        z = oz + r20 * cx + r21 * cy + r22 * cz
        wx, wy, wz = m * gx, m * gy, m * gz
        fx, fy, fz = fx + wx, fy + wy, fz + wz
        mx += y * wz - z * wy
        my += z * wx - x * wz
        mz += x * wy - y * wx
        if i == n:
            continue
        x, y, z = mx - (oy * fz - oz * fy), my - (oz * fx - ox * fz), mz - (ox * fy - oy * fx)
        b[U(j + MOMENT)], b[U(j + MOMENT + 1)], b[U(j + MOMENT + 2)] = x, y, z
        p = b[U(soft + 3 * i)] * (r00 * x + r10 * y + r20 * z)
        q = b[U(soft + 3 * i + 1)] * (r01 * x + r11 * y + r21 * z)
        turn = r02 * x + r12 * y + r22 * z
        r = b[U(soft + 3 * i + 2)] * turn / np.sqrt(1.0 + b[U(soft + 3 * n + i)] * turn * turn)
        change = max(change, abs(p - b[U(j + BEND)]), abs(q - b[U(j + BEND + 1)]))
        change = max(change, abs(r - b[U(j + BEND + 2)]))
        b[U(j + BEND)], b[U(j + BEND + 1)], b[U(j + BEND + 2)] = p, q, r
    # what is no number must not pass for no change
    fine = np.isfinite(fx + fy + fz + mx + my + mz)
    return change if fine else np.inf, mx, my, mz


@njit(**FAST)
def equilibrium(b, n, w):  # type: ignore[no-untyped-def]
    """Solve the row's deflected shape; returns the iterations, or -1 (``kernel.equilibrium``)."""
    give = 12 * (n + 1) + 12 + 9 * n + 3  # the base's compliance: last of the chain
    tx = ty = tz = 0.0
    for step in range(MAX_ITERATIONS):
        place(b, n, w, True, tx, ty, tz)
        change, mx, my, mz = load(b, n, w)
        x, y, z = b[U(give)] * mx, b[U(give + 1)] * my, b[U(give + 2)] * mz
        change = max(change, abs(x - tx), abs(y - ty), abs(z - tz))
        if change < TOLERANCE:
            return step + 1
        tx, ty, tz = x, y, z
        if not change < np.inf:
            break
    for i in range(n):
        j = w + RECORD * i + BEND
        b[U(j)] = b[U(j + 1)] = b[U(j + 2)] = 0.0
    return -1
