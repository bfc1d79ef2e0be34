"""Many rows side by side: the exact equilibrium of a block of rows, in loops that vectorise.

The same mechanics as core.kernel, which stays the reference (tests hold both together to 1e-12).
LANES rows lie side by side in one workspace, a slot of LANES numbers per quantity, so that each
loop over the lanes is straight arithmetic at compile-time distances: what a compiler turns into
vector instructions by itself. Sines come from polynomials for the same reason. Links that bend
themselves are left to core.kernel.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from core.kernel import JIT, TOLERANCE
from core.kernels.layout import (
    ANGLE,
    BEND,
    CHANGE,
    COG,
    FARTHEST,
    GROWTH,
    LANES,
    MASS,
    MOST_ROUNDS,
    RECORD,
    ROTATION,
    STEEPEST,
    TOTAL,
    WRENCH,
)
from core.kernels.mechanics import (
    bend_base,
    bend_joint,
    load_flange,
    load_joint,
    place_flange,
    place_joint,
    sines,
    turn_joint,
)


@njit(**JIT)
def _level(w):  # type: ignore[no-untyped-def]
    """Write the base's record as it stands without tilt."""
    for s in range(RECORD * LANES):
        w[s] = 0.0
    for k in range(LANES):
        w[ROTATION * LANES + k] = w[(ROTATION + 4) * LANES + k] = 1.0
        w[(ROTATION + 8) * LANES + k] = w[GROWTH * LANES + k] = 1.0


@njit(**JIT)
def gather(chain, rows, first, w, v):  # type: ignore[no-untyped-def]
    """Bring rows first.. into the lanes (the last row fills lanes that are over), unbent.

    Returns False where an angle is too large for ``sines``, or is no number.
    """
    n, last = chain.mass.shape[0], rows.q.shape[0] - 1
    fine = True
    _level(w)
    for k in range(LANES):
        r = min(first + k, last)
        for i in range(n):
            a = (i + 1) * RECORD * LANES + k
            fine = fine and abs(rows.q[r, i]) < FARTHEST
            w[a + ANGLE * LANES] = rows.q[r, i]
            w[a + GROWTH * LANES] = rows.growth[r, i]
            w[a + BEND * LANES] = w[a + (BEND + 1) * LANES] = w[a + (BEND + 2) * LANES] = 0.0
        v[MASS * LANES + k] = rows.payload_mass[r]
        for j in range(3):
            v[(COG + j) * LANES + k] = rows.payload_cog[r, j]
        for j in range(6):
            v[(WRENCH + j) * LANES + k] = rows.wrench[r, j]
    return fine


@njit(**JIT)
def settle(chain, w, v, bent):  # type: ignore[no-untyped-def]
    """Solve the lanes to equilibrium where ``bent``, else place and load the rigid arm once.

    Returns whether all lanes have settled.
    """
    n = chain.mass.shape[0]
    tilts = np.any(chain.base_compliance != 0.0)
    for i in range(n):
        sines(w, i + 1)
    for step in range(MOST_ROUNDS):
        if tilts and step:
            _upright(w)
            turn_joint(w, 0)
        for i in range(n):
            place_joint(w, i, chain.rotation[i], chain.position[i])
            if bent and step:
                turn_joint(w, i + 1)
        place_flange(w, v, n, chain)
        load_flange(w, v, n, chain.gravity)
        for i in range(n - 1, -1, -1):
            load_joint(w, i, chain.mass[i], chain.cog[i], chain.gravity)
            if bent:
                bend_joint(w, v, i + 1, chain.compliance[i], chain.softening[i])
        if not bent:
            return True
        if tilts:
            bend_base(w, v, chain.base_compliance)
        state = _settled(w, v, n)
        if state != 0:
            return state > 0
    return False


@njit(**JIT)
def _upright(w):  # type: ignore[no-untyped-def]
    for s in range(9):
        value = 1.0 if s % 4 == 0 else 0.0
        for k in range(LANES):
            w[(ROTATION + s) * LANES + k] = value


@njit(**JIT)
def _settled(w, v, n):  # type: ignore[no-untyped-def]
    """Return 1: all lanes rest, 0: not yet, -1: a lane is no number, or bends too far."""
    change, b = 0.0, RECORD * LANES
    for k in range(LANES):
        whole = 0.0
        for j in range(6):
            whole += w[b + (TOTAL + j) * LANES + k]
        if not np.isfinite(whole):
            return -1
        change = max(change, v[CHANGE * LANES + k])
        for i in range(n + 1):
            a = i * RECORD * LANES + k
            x, y, z = w[a + BEND * LANES], w[a + (BEND + 1) * LANES], w[a + (BEND + 2) * LANES]
            if not x * x + y * y + z * z < STEEPEST:
                return -1
    return 1 if change < TOLERANCE else 0


@njit(**JIT)
def bends(chain):  # type: ignore[no-untyped-def]
    """Return whether anything in the chain bends; links that do are core.kernel's."""
    return np.any(chain.compliance != 0.0) or np.any(chain.base_compliance != 0.0)
