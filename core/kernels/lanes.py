"""The exact equilibrium of a block of rows, in loops that the compiler vectorises.

The same mechanics as reference.py (tests compare both to 1e-12). A workspace holds LANES rows, a
slot of LANES numbers per quantity: each loop over the lanes is plain arithmetic with compile-time
strides. Sines are polynomials for the same reason. Flexible links are solved by
core.kernels.reference.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.layout import (
    ANGLE,
    BEND,
    CHANGE,
    COG,
    FAST,
    LANES,
    LINK_SCALE,
    MASS,
    MAX_ANGLE,
    MAX_BEND_SQUARE,
    MAX_ROUNDS,
    RECORD,
    ROTATION,
    ROW,
    TCP,
    TCP_ROTATION,
    TOTAL,
    WRENCH,
    U,
)
from gapbridge.core.kernels.mechanics import (
    bend_base,
    bend_joint,
    load_flange,
    load_joint,
    place_flange,
    place_joint,
    sines,
    turn_joint,
)
from gapbridge.core.kernels.reference import INNER, TOLERANCE


@njit(**INNER)
def lanes_of(n):  # type: ignore[no-untyped-def]
    """Return the workspaces for arms of n joints: records, and what belongs to whole rows."""
    w, v = np.zeros((n + 2) * RECORD * LANES), np.zeros(ROW * LANES)
    _level(w)
    return w, v


@njit(**INNER)
def _level(w):  # type: ignore[no-untyped-def]
    """Write the base's record without rotation."""
    for s in range(RECORD * LANES):
        w[s] = 0.0
    for k in range(LANES):
        w[ROTATION * LANES + k] = w[(ROTATION + 4) * LANES + k] = 1.0
        w[(ROTATION + 8) * LANES + k] = w[LINK_SCALE * LANES + k] = 1.0


@njit(**INNER)
def gather(chain, rows, first, w, v):  # type: ignore[no-untyped-def]
    """Bring rows first.. into the lanes (the last row fills lanes that are over).

    All but ``q`` may have a single row, which then counts for all. Returns False where an angle is
    too large for ``sines``, or is no number.
    """
    n, far = chain.mass.shape[0], 0
    _spread(rows.q, first, n, w, (RECORD + ANGLE) * LANES, RECORD * LANES)
    for i in range(n):
        a = ((i + 1) * RECORD + ANGLE) * LANES
        for k in range(LANES):
            far += 0 if abs(w[U(a + k)]) < MAX_ANGLE else 1  # what is no number is far, too
    _spread(rows.link_scale, first, n, w, (RECORD + LINK_SCALE) * LANES, RECORD * LANES)
    _spread(rows.payload_mass.reshape((-1, 1)), first, 1, v, MASS * LANES, LANES)
    _spread(rows.payload_cog, first, 3, v, COG * LANES, LANES)
    _spread(rows.wrench, first, 6, v, WRENCH * LANES, LANES)
    return far == 0


@njit(**INNER)
def _spread(given, first, width, to, begin, apart):  # type: ignore[no-untyped-def]
    """Write rows first.. of ``given`` (N or 1, width) into slots ``apart`` from each other."""
    last = given.shape[0] - 1
    if last == 0:
        for j in range(width):
            for k in range(LANES):
                to[U(begin + j * apart + k)] = given[0, j]
    elif first + LANES <= last:
        for k in range(0, LANES, 8):  # a cache line of each slot at a time
            for j in range(width):
                a = begin + j * apart + k
                for s in range(8):
                    to[U(a + s)] = given[U(first + k + s), U(j)]
    else:
        for k in range(LANES):
            r = min(first + k, last)
            for j in range(width):
                to[U(begin + j * apart + k)] = given[r, j]


@njit(**INNER)
def settle(chain, w, v, deflected, warm):  # type: ignore[no-untyped-def]
    """Solve the lanes to equilibrium where ``deflected``, else place and load the rigid arm once.

    ``warm``: from the bending that the lanes hold, not from the straight arm. Returns whether all
    lanes have settled.
    """
    n = chain.mass.shape[0]
    soft_base = _soft_base(chain)
    if not warm:
        _level(w)
        if deflected:
            _straighten(w, n)
    for i in range(n):
        sines(w, i + 1)
    before = 0.0
    for step in range(MAX_ROUNDS):
        turned = deflected and (warm or step > 0)
        _place(chain, w, v, n, soft_base and turned, turned)
        load_flange(w, v, n, chain.gravity)
        for i in range(n - 1, -1, -1):
            load_joint(w, i, chain.mass[i], chain.cog[i], chain.gravity)
            if deflected:
                bend_joint(w, v, i + 1, chain.compliance[i], chain.softening[i])
        if not deflected:
            return True
        if soft_base:
            bend_base(w, v, chain.base_compliance)
        change = _change(w, v, n)
        if change < 0.0:
            return False
        if change < TOLERANCE:
            return True
        if change * change < TOLERANCE * before:  # as it shrinks, the next is below the tolerance
            _place(chain, w, v, n, soft_base, True)
            return True
        before = change
    return False


@njit(**INNER)
def _place(chain, w, v, n, soft_base, turned):  # type: ignore[no-untyped-def]
    """Place everything from the base to the TCP; ``turned``: with the joints' bending."""
    if soft_base:
        _upright(w)
        turn_joint(w, 0)
    for i in range(n):
        place_joint(w, i, chain.rotation[i], chain.position[i])
        if turned:
            turn_joint(w, i + 1)
    place_flange(w, v, n, chain)


@njit(**FAST)
def _straighten(w, n):  # type: ignore[no-untyped-def]
    """Begin with joints that do not bend."""
    for i in range(n):
        a = ((i + 1) * RECORD + BEND) * LANES
        for s in range(3 * LANES):
            w[U(a + s)] = 0.0


@njit(**INNER)
def _upright(w):  # type: ignore[no-untyped-def]
    for s in range(9):
        value = 1.0 if s % 4 == 0 else 0.0
        for k in range(LANES):
            w[(ROTATION + s) * LANES + k] = value


@njit(**INNER)
def _change(w, v, n):  # type: ignore[no-untyped-def]
    """Return how far a lane's bending has changed at most (rad).

    -1 where a lane is no number, or bends too far.
    """
    change, b = 0.0, RECORD * LANES
    for k in range(LANES):
        whole = 0.0
        for j in range(6):
            whole += w[b + (TOTAL + j) * LANES + k]
        if not np.isfinite(whole):
            return -1.0
        change = max(change, v[CHANGE * LANES + k])
        for i in range(n + 1):
            a = i * RECORD * LANES + k
            x, y, z = w[a + BEND * LANES], w[a + (BEND + 1) * LANES], w[a + (BEND + 2) * LANES]
            if not x * x + y * y + z * z < MAX_BEND_SQUARE:
                return -1.0
    return change


@njit(**INNER)
def keep_pose(v, k, position, rotation):  # type: ignore[no-untyped-def]
    """Write the TCP pose of lane k."""
    for j in range(3):
        position[j] = v[(TCP + j) * LANES + k]
        for i in range(3):
            rotation[j, i] = v[(TCP_ROTATION + 3 * j + i) * LANES + k]


@njit(**INNER)
def bends(chain):  # type: ignore[no-untyped-def]
    """Return whether anything in the chain bends; links that do are core.kernels.reference's."""
    for i in range(chain.mass.shape[0]):
        for k in range(3):
            if chain.compliance[i, k] != 0.0:
                return True
    return _soft_base(chain)


@njit(**INNER)
def _soft_base(chain):  # type: ignore[no-untyped-def]
    """Return whether the base turns (np.any would bring scipy.linalg into each process)."""
    c = chain.base_compliance
    return c[0] != 0.0 or c[1] != 0.0 or c[2] != 0.0
