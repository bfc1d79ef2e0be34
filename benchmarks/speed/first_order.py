"""One setpoint to first order, in a time that does not depend on the load: no iteration.

The paper's linear form: the rigid arm's moments, the flexibilities times its regressor, and the
damped joint step that takes the TCP back. Where bending shifts the loads themselves, the exact way
(core.compensation) is better by the bending's share; tests hold both together.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.layout import FAST, U
from gapbridge.core.kernels.one_row import (
    AXIS,
    MOMENT,
    ORIGIN,
    RECORD,
    ROTATION,
    TCP,
    load,
    place,
)
from gapbridge.core.kernels.packed import sizes_of


@njit(**{**FAST, "no_cpython_wrapper": False})
def first_order(b, q, damping, found):  # type: ignore[no-untyped-def]
    """Write the joint step (n,) and the TCP's deflection (3,) at q (n,) into ``found``.

    ``b``: chain, row and workspace of core.kernels.one_row. The step is J'(J J' + damping^2)^-1
    times minus the deflection, J (3, n) of the TCP's position (m/rad; damping in m).
    """
    n = q.shape[0]
    row, size = sizes_of(n)
    w = row + size
    f = w + RECORD * n
    for i in range(n):
        b[U(row + i)] = q[U(i)]
    place(b, n, w, False, 0.0, 0.0, 0.0)
    load(b, n, w)
    px, py, pz = b[U(f + TCP)], b[U(f + TCP + 1)], b[U(f + TCP + 2)]
    soft = 12 * (n + 1) + 12 + 4 * n + 3
    ex = ey = ez = 0.0
    g00 = g11 = g22 = damping * damping
    g01 = g02 = g12 = 0.0
    for i in range(n):
        j = w + RECORD * i
        zx = b[U(j + ROTATION + 2)]
        zy, zz = b[U(j + ROTATION + 5)], b[U(j + ROTATION + 8)]
        mx, my, mz = b[U(j + MOMENT)], b[U(j + MOMENT + 1)], b[U(j + MOMENT + 2)]
        radial, axial = b[U(soft + 3 * i)], b[U(soft + 3 * i + 2)]
        along = (axial - radial) * (zx * mx + zy * my + zz * mz)
        tx, ty, tz = radial * mx + along * zx, radial * my + along * zy, radial * mz + along * zz
        x = px - b[U(j + ORIGIN)]
        y = py - b[U(j + ORIGIN + 1)]
        z = pz - b[U(j + ORIGIN + 2)]
        ex += ty * z - tz * y
        ey += tz * x - tx * z
        ez += tx * y - ty * x
        jx, jy, jz = zy * z - zz * y, zz * x - zx * z, zx * y - zy * x
        b[U(j + AXIS)], b[U(j + AXIS + 1)], b[U(j + AXIS + 2)] = jx, jy, jz  # J's column
        g00 += jx * jx
        g01 += jx * jy
        g02 += jx * jz
        g11 += jy * jy
        g12 += jy * jz
        g22 += jz * jz
    # Cholesky of the 3 x 3
    l00 = np.sqrt(g00)
    l10, l20 = g01 / l00, g02 / l00
    l11 = np.sqrt(g11 - l10 * l10)
    l21 = (g12 - l20 * l10) / l11
    l22 = np.sqrt(g22 - l20 * l20 - l21 * l21)
    y0 = -ex / l00
    y1 = (-ey - l10 * y0) / l11
    y2 = (-ez - l20 * y0 - l21 * y1) / l22
    y2 /= l22
    y1 = (y1 - l21 * y2) / l11
    y0 = (y0 - l10 * y1 - l20 * y2) / l00
    for i in range(n):
        j = w + RECORD * i + AXIS
        found[U(i)] = b[U(j)] * y0 + b[U(j + 1)] * y1 + b[U(j + 2)] * y2
    found[U(n)], found[U(n + 1)], found[U(n + 2)] = ex, ey, ez


def block_of(chain, row, n):  # type: ignore[no-untyped-def]
    """Return the block that ``first_order`` works in, from a packed chain and a packed row."""
    return np.concatenate([chain, row, np.zeros(27 * n + 24)])
