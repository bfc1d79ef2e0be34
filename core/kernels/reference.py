"""The compiled hot path: one bending chain, one row or many, no Python objects inside.

Everything a model knows is brought into the two records below (core/model.py fills them); the
functions then solve the deflected shape, its Jacobian and its linear form: eqs. 1 to 4 of
docs/conventions.md. Lists of buffers instead of results, so that one row needs no allocation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from gapbridge.core.arrays import Array

try:
    from gapbridge.core.kernels.machine_code import keep_by_all_sources

    KEPT = keep_by_all_sources()
except (ImportError, AttributeError):  # another numba: plain, and compiled in each process
    KEPT = False
JIT: dict[str, Any] = {
    "cache": KEPT, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True,
}  # fmt: skip
INNER = {**JIT, "no_cpython_wrapper": True}
"""What only compiled functions call: what Python would call it by takes a third of compiling."""
TOLERANCE = 1e-14  # rad and m: change of the shape at which the equilibrium counts as found
MAX_ITERATIONS = 200


class Chain(NamedTuple):
    """What does not change from row to row. n joints; SI units."""

    rotation: Array  # (n+1, 3, 3) link_in_link: [0] joint 1 in base, [n] flange in link n
    position: Array  # (n+1, 3) m
    tool_rotation: Array  # (3, 3) TCP in flange
    tool_position: Array  # (3,) m
    mass: Array  # (n,) kg
    cog: Array  # (n, 3) m, link axes
    gravity: Array  # (3,) m/s2, base axes
    compliance: Array  # (n, 3) rad/Nm about x, y (radial) and z (axial) of the bent joint frame
    softening: Array  # (n,) 1/(Nm)2: axial theta = c M / sqrt(1 + softening M^2)
    flexibility: Array  # (n,) 1/(N m2): 1/EI of link i, from joint i to joint i+1; [n-1] is unused
    base_compliance: Array  # (3,) rad/Nm about the base axes


class Rows(NamedTuple):
    """What changes from row to row. N rows, contiguous."""

    q: Array  # (N, n) rad, true joint angles
    link_scale: Array  # (N, n) factor on link i's length
    payload_mass: Array  # (N,) kg
    payload_cog: Array  # (N, 3) m, flange axes
    wrench: Array  # (N, 6) N, Nm: surroundings on the tool at the TCP, base axes


class Shape(NamedTuple):
    """Where everything is once it has bent: one row's buffers, base axes."""

    origin: Array  # (n+1, 3) m: joints 1..n, then the flange
    rotation: Array  # (n+1, 3, 3): links 1..n after bending, then the flange
    axis: Array  # (n, 3) joint axes before bending: what an encoder turns about
    moment: Array  # (n, 3) Nm, of everything beyond, base axes
    bend: Array  # (n, 3) rad, bent joint frame
    tip: Array  # (n, 6) m, rad: far end of a flexible link, link axes
    tcp_position: Array  # (3,) m
    tcp_rotation: Array  # (3, 3)


def new_shape(n: int) -> Shape:
    """Return empty buffers for an arm of n joints."""
    return Shape(
        np.zeros((n + 1, 3)), np.zeros((n + 1, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3)),
        np.zeros((n, 3)), np.zeros((n, 6)), np.zeros(3), np.zeros((3, 3)),
    )  # fmt: skip


_new_shape = njit(**INNER)(new_shape)


@njit(inline="always", **JIT)
def _times(A, B, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@njit(inline="always", **JIT)
def _turn(x, y, z, out):  # type: ignore[no-untyped-def]
    """Write the rotation matrix of the rotation vector (x, y, z)."""
    square = x * x + y * y + z * z
    if square < 1e-8:
        first = 1.0 - square / 6.0
        second = 0.5 - square / 24.0
    else:
        angle = np.sqrt(square)
        first = np.sin(angle) / angle
        second = (1.0 - np.cos(angle)) / square
    out[0, 0] = 1.0 - second * (y * y + z * z)
    out[0, 1] = second * x * y - first * z
    out[0, 2] = second * x * z + first * y
    out[1, 0] = second * x * y + first * z
    out[1, 1] = 1.0 - second * (x * x + z * z)
    out[1, 2] = second * y * z - first * x
    out[2, 0] = second * x * z - first * y
    out[2, 1] = second * y * z + first * x
    out[2, 2] = 1.0 - second * (x * x + y * y)


@njit(inline="always", **JIT)
def copy_vector(a, out):  # type: ignore[no-untyped-def]
    """Copy a vector (3,).

    ``out[:] = a`` looks whether the two overlap in memory, and brings the text of its error with
    it, which each process that loads the machine code pays for.
    """
    for i in range(3):
        out[i] = a[i]


@njit(inline="always", **JIT)
def copy_matrix(A, out):  # type: ignore[no-untyped-def]
    """Copy a matrix (N, 3), as ``copy_vector`` does a vector."""
    for i in range(A.shape[0]):
        for j in range(3):
            out[i, j] = A[i, j]


@njit(**INNER)
def place(chain, rows, r, shape, base_rotation, A, B):  # type: ignore[no-untyped-def]
    """Place all frames for the present bending (exact finite rotations)."""
    n = chain.mass.shape[0]
    _turn(base_rotation[0], base_rotation[1], base_rotation[2], A)
    ox = oy = oz = 0.0
    for i in range(n + 1):
        g = 1.0
        if i > 0:
            g = rows.link_scale[r, i - 1]
        vx, vy, vz = g * chain.position[i, 0], g * chain.position[i, 1], g * chain.position[i, 2]
        if i > 0 and i < n and chain.flexibility[i - 1] != 0.0:
            t = shape.tip[i - 1]
            vx, vy, vz = vx + t[0], vy + t[1], vz + t[2]
        ox += A[0, 0] * vx + A[0, 1] * vy + A[0, 2] * vz
        oy += A[1, 0] * vx + A[1, 1] * vy + A[1, 2] * vz
        oz += A[2, 0] * vx + A[2, 1] * vy + A[2, 2] * vz
        shape.origin[i, 0], shape.origin[i, 1], shape.origin[i, 2] = ox, oy, oz
        if i > 0 and i < n and chain.flexibility[i - 1] != 0.0:
            t = shape.tip[i - 1]
            _turn(t[3], t[4], t[5], B)
            _times(A, B, shape.rotation[i])
            copy_matrix(shape.rotation[i], A)
        _times(A, chain.rotation[i], B)
        if i == n:
            copy_matrix(B, shape.rotation[n])
            break
        c, s = np.cos(rows.q[r, i]), np.sin(rows.q[r, i])
        for k in range(3):
            bx, by = B[k, 0], B[k, 1]
            B[k, 0], B[k, 1] = c * bx + s * by, c * by - s * bx
            shape.axis[i, k] = B[k, 2]
        _turn(shape.bend[i, 0], shape.bend[i, 1], shape.bend[i, 2], A)
        _times(B, A, shape.rotation[i])
        copy_matrix(shape.rotation[i], A)
    for k in range(3):
        R = shape.rotation[n]
        p = chain.tool_position
        shape.tcp_position[k] = (
            shape.origin[n, k] + R[k, 0] * p[0] + R[k, 1] * p[1] + R[k, 2] * p[2]
        )
    _times(shape.rotation[n], chain.tool_rotation, shape.tcp_rotation)


@njit(inline="always", **JIT)
def _add_load(total, fx, fy, fz, px, py, pz):  # type: ignore[no-untyped-def]
    """Add a force at a point to (force, moment about the base origin)."""
    total[0] += fx
    total[1] += fy
    total[2] += fz
    total[3] += py * fz - pz * fy
    total[4] += pz * fx - px * fz
    total[5] += px * fy - py * fx


@njit(**INNER)
def _load(chain, rows, r, shape, base_rotation, total):  # type: ignore[no-untyped-def]
    """Newton-Euler statics from tip to base (paper eqs. 6-8) and the bending it makes.

    Returns the largest change of the bending; ``base_rotation`` gets the base's own.
    """
    n = chain.mass.shape[0]
    g = chain.gravity
    w = rows.wrench[r]
    p = shape.tcp_position
    total[:] = 0.0
    total[3], total[4], total[5] = w[3], w[4], w[5]
    _add_load(total, w[0], w[1], w[2], p[0], p[1], p[2])
    R, o, c, m = shape.rotation[n], shape.origin[n], rows.payload_cog[r], rows.payload_mass[r]
    _add_load(
        total, m * g[0], m * g[1], m * g[2],
        o[0] + R[0, 0] * c[0] + R[0, 1] * c[1] + R[0, 2] * c[2],
        o[1] + R[1, 0] * c[0] + R[1, 1] * c[1] + R[1, 2] * c[2],
        o[2] + R[2, 0] * c[0] + R[2, 1] * c[1] + R[2, 2] * c[2],
    )  # fmt: skip
    change, link = 0.0, np.empty((3, 3))
    for i in range(n - 1, -1, -1):
        R, o = shape.rotation[i], shape.origin[i]
        if i < n - 1 and chain.flexibility[i] != 0.0:
            change = max(change, _flex(chain, rows, r, shape, i, total, link))
        c, m = chain.cog[i], chain.mass[i]
        _add_load(
            total, m * g[0], m * g[1], m * g[2],
            o[0] + R[0, 0] * c[0] + R[0, 1] * c[1] + R[0, 2] * c[2],
            o[1] + R[1, 0] * c[0] + R[1, 1] * c[1] + R[1, 2] * c[2],
            o[2] + R[2, 0] * c[0] + R[2, 1] * c[1] + R[2, 2] * c[2],
        )  # fmt: skip
        mx = total[3] - (o[1] * total[2] - o[2] * total[1])
        my = total[4] - (o[2] * total[0] - o[0] * total[2])
        mz = total[5] - (o[0] * total[1] - o[1] * total[0])
        shape.moment[i, 0], shape.moment[i, 1], shape.moment[i, 2] = mx, my, mz
        for k in range(3):
            M = R[0, k] * mx + R[1, k] * my + R[2, k] * mz
            bend = chain.compliance[i, k] * M
            if k == 2:
                bend /= np.sqrt(1.0 + chain.softening[i] * M * M)
            change = max(change, abs(bend - shape.bend[i, k]))
            shape.bend[i, k] = bend
    for k in range(3):
        bend = chain.base_compliance[k] * total[3 + k]
        change = max(change, abs(bend - base_rotation[k]))
        base_rotation[k] = bend
    return change


@njit(**INNER)
def _flex(chain, rows, r, shape, i, total, link):  # type: ignore[no-untyped-def]
    """Bend link i as a cantilever loaded at its far end; returns the largest change.

    ``link`` (3, 3) is a buffer: force, moment and direction in the link's axes.
    """
    R, o = shape.rotation[i], shape.origin[i + 1]
    f, M, u = link[0], link[1], link[2]
    length = 0.0
    mx = total[3] - (o[1] * total[2] - o[2] * total[1])
    my = total[4] - (o[2] * total[0] - o[0] * total[2])
    mz = total[5] - (o[0] * total[1] - o[1] * total[0])
    for k in range(3):
        f[k] = R[0, k] * total[0] + R[1, k] * total[1] + R[2, k] * total[2]
        M[k] = R[0, k] * mx + R[1, k] * my + R[2, k] * mz
        u[k] = chain.position[i + 1, k] * rows.link_scale[r, i]
        length += u[k] * u[k]
    length = np.sqrt(length)
    if length < 1e-9:
        return 0.0
    for k in range(3):
        u[k] /= length
    s, change = chain.flexibility[i], 0.0
    along_f = f[0] * u[0] + f[1] * u[1] + f[2] * u[2]
    along_m = M[0] * u[0] + M[1] * u[1] + M[2] * u[2]
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        u_cross_f = u[a] * f[b] - u[b] * f[a]
        m_cross_u = M[a] * u[b] - M[b] * u[a]
        push = f[k] - along_f * u[k]
        moment = M[k] - along_m * u[k]
        shift = s * (push * length**3 / 3.0 + m_cross_u * length**2 / 2.0)
        angle = s * (u_cross_f * length**2 / 2.0 + moment * length)
        change = max(change, abs(shift - shape.tip[i, k]), abs(angle - shape.tip[i, 3 + k]))
        shape.tip[i, k], shape.tip[i, 3 + k] = shift, angle
    return change


@njit(inline="always", **JIT)
def _sum(total):  # type: ignore[no-untyped-def]
    return total[0] + total[1] + total[2] + total[3] + total[4] + total[5]


@njit(**JIT)
def equilibrium(chain, rows, r, shape):  # type: ignore[no-untyped-def]
    """Solve the deflected shape of row r to equilibrium; returns the iterations it took.

    Starts from the bending that ``shape`` holds (zeros: cold). Returns -1 where it does not settle
    (a load under which the arm would buckle) or a number is not finite.
    """
    A, B = np.empty((3, 3)), np.empty((3, 3))
    base_rotation, total = np.zeros(3), np.empty(6)
    for step in range(MAX_ITERATIONS):
        place(chain, rows, r, shape, base_rotation, A, B)
        change = _load(chain, rows, r, shape, base_rotation, total)
        # a change that is not a number would pass for none
        if change < TOLERANCE and np.isfinite(_sum(total)):
            return step + 1
    shape.bend[:, :] = 0.0  # what cannot be solved must not spoil the next row
    shape.tip[:, :] = 0.0
    return -1


@njit(**JIT)
def predict_rows(chain, rows, position, rotation):  # type: ignore[no-untyped-def]
    """Write the TCP pose of every row; returns the first row without equilibrium, or -1."""
    return predict_range(chain, rows, 0, rows.q.shape[0], position, rotation)


@njit(**INNER)
def predict_range(chain, rows, first, last, position, rotation):  # type: ignore[no-untyped-def]
    """``predict_rows`` of rows first..last."""
    shape, bad = _new_shape(chain.mass.shape[0]), -1
    for r in range(first, last):
        if equilibrium(chain, rows, r, shape) < 0 and bad < 0:
            bad = r
        copy_vector(shape.tcp_position, position[r])
        copy_matrix(shape.tcp_rotation, rotation[r])
    return bad


@njit(**INNER)
def jacobian(shape, J):  # type: ignore[no-untyped-def]
    """Write the geometric Jacobian (6, n) of the TCP in base axes for the present shape."""
    p = shape.tcp_position
    for i in range(shape.axis.shape[0]):
        z, o = shape.axis[i], shape.origin[i]
        x, y, w = p[0] - o[0], p[1] - o[1], p[2] - o[2]
        J[0, i] = z[1] * w - z[2] * y
        J[1, i] = z[2] * x - z[0] * w
        J[2, i] = z[0] * y - z[1] * x
        J[3, i], J[4, i], J[5, i] = z[0], z[1], z[2]


@njit(**JIT)
def regressor_rows(chain, rows, A, jacobians, moments):  # type: ignore[no-untyped-def]
    """Write d pose / d flexibility (N, 6, 2n) at the shape the chain has: axial, then radial.

    Eqs. 3 and 4 of docs/conventions.md: column i is z_i M_z,i turned about joint i, column
    n+i the radial moment likewise. Also the Jacobians (N, 6, n) and joint moments (N, n, 3), base
    axes. Returns the first row without equilibrium, or -1.
    """
    n = chain.mass.shape[0]
    shape, bad = _new_shape(n), -1
    for r in range(rows.q.shape[0]):
        if equilibrium(chain, rows, r, shape) < 0 and bad < 0:
            bad = r
        jacobian(shape, jacobians[r])
        copy_matrix(shape.moment, moments[r])
        p = shape.tcp_position
        for i in range(n):
            z, M, o = shape.rotation[i][:, 2], shape.moment[i], shape.origin[i]
            along = z[0] * M[0] + z[1] * M[1] + z[2] * M[2]
            for k in range(3):
                A[r, 3 + k, i] = along * z[k]
                A[r, 3 + k, n + i] = M[k] - along * z[k]
            for column in (i, n + i):
                for k in range(3):
                    a, b = (k + 1) % 3, (k + 2) % 3
                    A[r, k, column] = A[r, 3 + a, column] * (p[b] - o[b]) - A[r, 3 + b, column] * (
                        p[a] - o[a]
                    )
    return bad
