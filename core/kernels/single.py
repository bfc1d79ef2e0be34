"""The correction of one setpoint in one call, and its inverse, over blocks (kernels.one_row)."""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.layout import FAST, U
from gapbridge.core.kernels.least_offset import LARGEST_OFFSET, REGULAR, smallest_offset
from gapbridge.core.kernels.one_row import (
    AXIS,
    FLANGE,
    ORIGIN,
    RECORD,
    TCP,
    TCP_ROTATION,
    equilibrium,
    place,
    turn,
)
from gapbridge.core.kernels.packed import sizes_of
from gapbridge.core.kernels.reference import INNER, JIT

LEVER = 0.5  # m: weighs a rotation against a shift
TOLERANCE = 1e-9  # m, and rad times the lever: where the pose counts as reached
MAX_STEPS = 12
NEARER, FEWER = 1e-10, 8  # the same of an offset that is taken out
SCRATCH = 42  # numbers that a search needs besides


@njit(**FAST)
def newton_offset(b, n, w, wanted, k0):  # type: ignore[no-untyped-def]
    """Write the next joint offset (after the workspace), as ``compensation.next_offset`` does.

    The wanted pose stands in the block ``wanted`` from ``k0`` on, twelve numbers.
    """
    if equilibrium(b, n, w) < 0:
        return -1.0
    f, J = w + RECORD * n, w + RECORD * n + FLANGE
    at = J + 6 * n
    px, py, pz = b[U(f + TCP)], b[U(f + TCP + 1)], b[U(f + TCP + 2)]
    e0, e1, e2 = wanted[U(k0)] - px, wanted[U(k0 + 1)] - py, wanted[U(k0 + 2)] - pz
    e3 = e4 = e5 = 0.0
    for c in range(3):
        r = f + TCP_ROTATION + c
        r0, r1, r2 = b[U(r)], b[U(r + 3)], b[U(r + 6)]
        v0, v1, v2 = wanted[U(k0 + 3 + c)], wanted[U(k0 + 6 + c)], wanted[U(k0 + 9 + c)]
        e3 += r1 * v2 - r2 * v1
        e4 += r2 * v0 - r0 * v2
        e5 += r0 * v1 - r1 * v0
    half = 0.5 * LEVER
    e3, e4, e5 = half * e3, half * e4, half * e5
    distance = np.sqrt(e0 * e0 + e1 * e1 + e2 * e2 + e3 * e3 + e4 * e4 + e5 * e5)
    if not np.isfinite(distance):
        return -1.0
    for i in range(n):
        j, c = w + RECORD * i, J + 6 * i
        zx, zy, zz = b[U(j + AXIS)], b[U(j + AXIS + 1)], b[U(j + AXIS + 2)]
        x = px - b[U(j + ORIGIN)]
        y = py - b[U(j + ORIGIN + 1)]
        z = pz - b[U(j + ORIGIN + 2)]
        b[U(c)], b[U(c + 1)], b[U(c + 2)] = zy * z - zz * y, zz * x - zx * z, zx * y - zy * x
        b[U(c + 3)], b[U(c + 4)], b[U(c + 5)] = LEVER * zx, LEVER * zy, LEVER * zz
        # the whole offset is solved for, not an increment
        o = b[U(at + i)]
        e0, e1, e2 = e0 + b[U(c)] * o, e1 + b[U(c + 1)] * o, e2 + b[U(c + 2)] * o
        e3, e4, e5 = e3 + b[U(c + 3)] * o, e4 + b[U(c + 4)] * o, e5 + b[U(c + 5)] * o
    error = (e0, e1, e2, e3, e4, e5)
    if n > 6 or not _shortest(b, n, J, error):
        _damped(b, n, J, error)
    return distance


@njit(**FAST)
def _shortest(b, n, J, error):  # type: ignore[no-untyped-def]
    """Write the offset by Cholesky; returns False where it is near singular, or too long."""
    at = J + 6 * n
    e0, e1, e2, e3, e4, e5 = error
    G, y = at + n, at + n + 36
    least, most = np.inf, 0.0
    for i in range(n):
        c = J + 6 * i
        b[U(y + i)] = b[U(c)] * e0 + b[U(c + 1)] * e1 + b[U(c + 2)] * e2 + (
            b[U(c + 3)] * e3 + b[U(c + 4)] * e4 + b[U(c + 5)] * e5
        )  # fmt: skip
        for j in range(i + 1):
            d = J + 6 * j
            total = b[U(c)] * b[U(d)] + b[U(c + 1)] * b[U(d + 1)] + b[U(c + 2)] * b[U(d + 2)] + (
                b[U(c + 3)] * b[U(d + 3)] + b[U(c + 4)] * b[U(d + 4)] + b[U(c + 5)] * b[U(d + 5)]
            )  # fmt: skip
            for k in range(j):
                total -= b[U(G + 6 * i + k)] * b[U(G + 6 * j + k)]
            if i > j:
                b[U(G + 6 * i + j)] = total * b[U(G + 6 * j + j)]
                continue
            least, most = min(least, total), max(most, total)
            if not least > REGULAR * most:
                return False
            b[U(G + 6 * i + i)] = 1.0 / np.sqrt(total)
    for i in range(n):
        total = b[U(y + i)]
        for k in range(i):
            total -= b[U(G + 6 * i + k)] * b[U(y + k)]
        b[U(y + i)] = total * b[U(G + 6 * i + i)]
    square = 0.0
    for i in range(n - 1, -1, -1):
        total = b[U(y + i)]
        for k in range(i + 1, n):
            total -= b[U(G + 6 * k + i)] * b[U(y + k)]
        total *= b[U(G + 6 * i + i)]
        b[U(y + i)] = total
        square += total * total
    if not square <= LARGEST_OFFSET * LARGEST_OFFSET:
        return False
    for i in range(n):
        b[U(at + i)] = b[U(y + i)]
    return True


@njit(**INNER)
def _damped(b, n, J, error):  # type: ignore[no-untyped-def]
    """Write the offset by core.kernels.least_offset: singular poses, more than six joints."""
    whole, wanted, found = np.empty((6, n)), np.array(error), np.empty(n)
    for i in range(n):
        for k in range(6):
            whole[k, i] = b[J + 6 * i + k]
    smallest_offset(whole, wanted, found)
    for i in range(n):
        b[J + 6 * n + i] = found[i]


@njit(**FAST)
def rigid_pose(b, n, w, q, first, pose):  # type: ignore[no-untyped-def]
    """Place the block's arm unbent at the angles that begin at q[first]; the pose to b[pose]."""
    row = sizes_of(n)[0]
    for i in range(n):
        b[U(row + i)] = q[U(first + i)]
    place(b, n, w, False, 0.0, 0.0, 0.0)
    f = w + RECORD * n + TCP
    for k in range(12):
        b[U(pose + k)] = b[U(f + k)]


@njit(**JIT)
def correct(b, nominal, mass, cog, wrench, found):  # type: ignore[no-untyped-def]
    """Write the corrected setpoint and the rigid motion it makes (n + 6,) into ``found``.

    ``b``, kept from call to call: chain, row, workspace, offset (n,), scratch; chain, row and
    workspace of the rigid arm, the wanted pose and the reached one (12 each). ``mass`` (1,),
    ``cog`` (1, 3) and ``wrench`` (1, 6) as in Loads. Returns the distance (m) that is left, and the
    steps taken.
    """
    n = nominal.shape[0]
    c, size = sizes_of(n)
    w, row = c + size, c
    at = w + (RECORD + 6) * n + FLANGE
    wanted = at
    r = b[at + n + SCRATCH :]
    load = row + 2 * n
    b[U(load)] = mass[0]
    for k in range(3):
        b[U(load + 1 + k)] = cog[0, k]
    for k in range(6):
        b[U(load + 4 + k)] = wrench[0, k]
    rigid_pose(r, n, w, nominal, 0, wanted)
    best, steps = np.inf, 0
    for i in range(n):
        found[i] = nominal[i]
    for _ in range(MAX_STEPS):
        steps += 1
        for i in range(n):
            b[U(row + i)] = nominal[i] + b[U(at + i)]
        distance = newton_offset(b, n, w, r, wanted)
        if distance < 0:
            break
        if distance < best:
            best = distance
            for i in range(n):
                found[i] = b[U(row + i)]
        if distance < TOLERANCE:
            break
    moves = False
    for i in range(n):
        # where nothing was found, nothing (nor a joint angle that is no number) may go on
        b[U(at + i)] = found[i] - nominal[i] if best < np.inf else 0.0
        moves = moves or b[U(at + i)] != 0.0
    rigid_pose(r, n, w, found, 0, wanted + 12)
    motion(r[wanted : wanted + 12], r[wanted + 12 : wanted + 24], moves, found[n:])
    return best, steps


@njit(**JIT)
def correct_rows(b, nominal, mass, cog, wrench, out):  # type: ignore[no-untyped-def]
    """``correct`` row after row: nominal (N, n), ``out`` found (N, n + 6), residual, steps (N,).

    Each from no offset: rows near singularities have little to do with the one before.
    """
    n = nominal.shape[1]
    found, residual, steps = out
    c, size = sizes_of(n)
    at = c + size + (RECORD + 6) * n + FLANGE
    for r in range(nominal.shape[0]):
        b[at : at + n] = 0.0
        residual[r], steps[r] = correct(
            b, nominal[r], mass[r : r + 1], cog[r : r + 1], wrench[r : r + 1], found[r]
        )


@njit(**JIT)
def motion(wanted, pose, moves, out):  # type: ignore[no-untyped-def]
    """Write the motion (6,) from the wanted pose (12,) to another; nothing where nothing moves."""
    for k in range(3):
        out[k] = pose[k] - wanted[k] if moves else 0.0
        out[3 + k] = 0.0
    if moves:
        _turned(pose[3:], wanted[3:], out)


@njit(**INNER)
def _turned(A, B, out):  # type: ignore[no-untyped-def]
    """Write the rotation vector of A B^T (9 each, by rows) behind a shift; accurate at zero."""
    x = y = z = trace = 0.0
    for k in range(3):
        x += A[6 + k] * B[3 + k] - A[3 + k] * B[6 + k]
        y += A[k] * B[6 + k] - A[6 + k] * B[k]
        z += A[3 + k] * B[k] - A[k] * B[3 + k]
        trace += A[k] * B[k] + A[3 + k] * B[3 + k] + A[6 + k] * B[6 + k]
    twice_sine = np.sqrt(x * x + y * y + z * z)
    # offsets are small: half turns, where the sine alone says nothing, do not occur
    scale = np.arctan2(twice_sine, trace - 1.0) / twice_sine if twice_sine > 1e-12 else 0.5
    out[3], out[4], out[5] = scale * x, scale * y, scale * z


@njit(**JIT)
def take_out(b, found):  # type: ignore[no-untyped-def]
    """Write the joints (n,) at which the rigid TCP is an offset short of where a target has it.

    ``b``, kept from call to call: chain, row, workspace of the rigid arm, joint offset (n,),
    scratch, wanted pose (12,); target (n,) and offset (6,) in base. Returns the distance (m) that
    is left.
    """
    n = found.shape[0]
    c, size = sizes_of(n)
    w, row = c + size, c
    at = w + (RECORD + 6) * n + FLANGE
    wanted = at + n + SCRATCH
    given = b[wanted + 12 :]
    if not np.any(given[n:] != 0.0):  # no offset changes no bit
        for i in range(n):
            found[i], b[U(at + i)] = given[i], 0.0
        return 0.0
    rigid_pose(b, n, w, given, 0, wanted)
    _move_back(b, wanted, given, n)
    distance = np.inf
    for _ in range(FEWER):
        for i in range(n):
            b[U(row + i)] = given[i] + b[U(at + i)]
        distance = newton_offset(b, n, w, b, wanted)
        if distance < NEARER:
            break
    distance = distance if distance >= 0.0 else np.inf
    for i in range(n):
        found[i] = b[U(row + i)]
        if not distance < NEARER:
            b[U(at + i)] = 0.0  # the next search begins from nothing
    return distance


@njit(**FAST)
def _move_back(b, pose, given, n):  # type: ignore[no-untyped-def]
    """Move a pose (12,) of the block by the opposite of the offset behind the target."""
    for k in range(3):
        b[U(pose + k)] -= given[n + k]
    x, y, z = -given[n + 3], -given[n + 4], -given[n + 5]
    first, second = turn(x, y, z)
    for k in range(3):
        r = pose + 3 + k
        b0, b1, b2 = b[U(r)], b[U(r + 3)], b[U(r + 6)]
        u, v, s = y * b2 - z * b1, z * b0 - x * b2, x * b1 - y * b0  # vector x column
        b[U(r)] = b0 + first * u + second * (y * s - z * v)
        b[U(r + 3)] = b1 + first * v + second * (z * u - x * s)
        b[U(r + 6)] = b2 + first * s + second * (x * v - y * u)
