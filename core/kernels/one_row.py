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


@njit(inline="always", **FAST)
def _matrix(x, y, z):  # type: ignore[no-untyped-def]
    """Return the rotation matrix of a rotation vector, by rows."""
    first, second = turn(x, y, z)
    return (
        1.0 - second * (y * y + z * z), second * x * y - first * z, second * x * z + first * y,
        second * x * y + first * z, 1.0 - second * (x * x + z * z), second * y * z - first * x,
        second * x * z - first * y, second * y * z + first * x, 1.0 - second * (x * x + y * y),
    )  # fmt: skip


@njit(inline="always", **FAST)
def _times(a, b):  # type: ignore[no-untyped-def]
    """Return the product of two matrices, by rows."""
    return (
        a[0] * b[0] + a[1] * b[3] + a[2] * b[6], a[0] * b[1] + a[1] * b[4] + a[2] * b[7],
        a[0] * b[2] + a[1] * b[5] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[3] + a[5] * b[6], a[3] * b[1] + a[4] * b[4] + a[5] * b[7],
        a[3] * b[2] + a[4] * b[5] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[3] + a[8] * b[6], a[6] * b[1] + a[7] * b[4] + a[8] * b[7],
        a[6] * b[2] + a[7] * b[5] + a[8] * b[8],
    )  # fmt: skip


@njit(inline="always", **FAST)
def _nine(b, k):  # type: ignore[no-untyped-def]
    """Return nine numbers of the block."""
    return (
        b[U(k)], b[U(k + 1)], b[U(k + 2)], b[U(k + 3)], b[U(k + 4)], b[U(k + 5)], b[U(k + 6)],
        b[U(k + 7)], b[U(k + 8)],
    )  # fmt: skip


@njit(**FAST)
def place(b, n, w, deflected, tx, ty, tz):  # type: ignore[no-untyped-def]
    """Place all frames of the block's row for the present bending and rotation of the base."""
    a = _matrix(tx, ty, tz)
    ox = oy = oz = 0.0
    shift = 9 * (n + 1)  # from the rotations to the positions
    row = sizes_of(n)[0]
    for i in range(n + 1):
        g = b[U(row + n + i - 1)] if i > 0 else 1.0
        p = shift + 3 * i
        x, y, z = g * b[U(p)], g * b[U(p + 1)], g * b[U(p + 2)]
        ox += a[0] * x + a[1] * y + a[2] * z
        oy += a[3] * x + a[4] * y + a[5] * z
        oz += a[6] * x + a[7] * y + a[8] * z
        a = _times(a, _nine(b, 9 * i))
        j = w + RECORD * i
        if i < n:
            c, s = np.cos(b[U(row + i)]), np.sin(b[U(row + i)])
            a = (
                c * a[0] + s * a[1], c * a[1] - s * a[0], a[2],
                c * a[3] + s * a[4], c * a[4] - s * a[3], a[5],
                c * a[6] + s * a[7], c * a[7] - s * a[6], a[8],
            )  # fmt: skip
            b[U(j + AXIS)], b[U(j + AXIS + 1)], b[U(j + AXIS + 2)] = a[2], a[5], a[8]
            if deflected:
                a = _times(a, _matrix(b[U(j + BEND)], b[U(j + BEND + 1)], b[U(j + BEND + 2)]))
        b[U(j)], b[U(j + 1)], b[U(j + 2)] = a[0], a[1], a[2]
        b[U(j + 3)], b[U(j + 4)], b[U(j + 5)] = a[3], a[4], a[5]
        b[U(j + 6)], b[U(j + 7)], b[U(j + 8)] = a[6], a[7], a[8]
        b[U(j + ORIGIN)], b[U(j + ORIGIN + 1)], b[U(j + ORIGIN + 2)] = ox, oy, oz
    _place_tool(b, 12 * (n + 1), w + RECORD * n)


@njit(inline="always", **FAST)
def _place_tool(b, t, f):  # type: ignore[no-untyped-def]
    """Place the TCP; the tool's rotation begins at ``t``, the flange's record at ``f``."""
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
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = _nine(b, j)
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
