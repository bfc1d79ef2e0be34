"""The task of one setpoint, and the regressor of many, in plain numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.kernels.reference import Chain, Rows

Array = NDArray[np.float64]


def setpoint(chain: Chain, row: Rows, damping: float) -> tuple[Array, Array]:
    """Return joint step (n,) and deflection (3,) of one row, to first order."""
    n = len(chain.mass)
    R, o = np.eye(3), np.zeros(3)
    rotation, origin = np.empty((n, 3, 3)), np.empty((n, 3))
    for i in range(n):
        c, s = np.cos(row.q[0, i]), np.sin(row.q[0, i])
        o = o + R @ chain.position[i]
        R = R @ chain.rotation[i] @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        rotation[i], origin[i] = R, o
    o = o + R @ chain.position[n]
    R = R @ chain.rotation[n]
    tcp = o + R @ chain.tool_position
    weight = row.payload_mass[0] * chain.gravity
    force = row.wrench[0, :3] + weight
    about = row.wrench[0, 3:] + np.cross(tcp, row.wrench[0, :3])
    about = about + np.cross(o + R @ row.payload_cog[0], weight)
    e, J = np.zeros(3), np.empty((3, n))
    for i in range(n - 1, -1, -1):
        weight = chain.mass[i] * chain.gravity
        force = force + weight
        about = about + np.cross(origin[i] + rotation[i] @ chain.cog[i], weight)
        moment = about - np.cross(origin[i], force)
        bend = rotation[i] @ (chain.compliance[i] * (moment @ rotation[i]))
        e += np.cross(bend, tcp - origin[i])
        J[:, i] = np.cross(rotation[i][:, 2], tcp - origin[i])
    return J.T @ np.linalg.solve(J @ J.T + damping**2 * np.eye(3), -e), e


def regressor(chain: Chain, rows: Rows, A: Array) -> None:
    """Write the regressor (2n, 3, N), block by block; a quantity of a block is one array.

    Structure of arrays, 2048 rows at once: the quickest that plain numpy has been made here.
    """
    for first in range(0, len(rows.q), 2048):
        part = slice(first, first + 2048)
        _block(chain, Rows(*(field[part] for field in rows)), A[:, :, part])


def _cross(a: Array, b: Array) -> Array:
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _times(R: Array, v: Array) -> Array:
    """Return R (3, 3, N) times a constant vector (3,), or one per row (3, N)."""
    return R[:, 0] * v[0] + R[:, 1] * v[1] + R[:, 2] * v[2]


def _block(chain: Chain, rows: Rows, A: Array) -> None:
    n, count = len(chain.mass), len(rows.q)
    R = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, count))
    o = np.zeros((3, count))
    rotation, origin = [], []
    for i in range(n):
        o = o + _times(R, chain.position[i])
        B = [_times(R, chain.rotation[i][:, k]) for k in range(3)]
        c, s = np.cos(rows.q[:, i]), np.sin(rows.q[:, i])
        R = np.stack([c * B[0] + s * B[1], c * B[1] - s * B[0], B[2]], axis=1)
        rotation.append(R)
        origin.append(o)
    o = o + _times(R, chain.position[n])
    flange = np.stack([_times(R, chain.rotation[n][:, k]) for k in range(3)], axis=1)
    tcp = o + _times(flange, chain.tool_position)
    weight = rows.payload_mass * chain.gravity[:, None]
    pull = rows.wrench[:, :3].T
    force = pull + weight
    about = rows.wrench[:, 3:].T + _cross(tcp, pull)
    about = about + _cross(o + _times(flange, rows.payload_cog.T), weight)
    for i in range(n - 1, -1, -1):
        weight = np.broadcast_to((chain.mass[i] * chain.gravity)[:, None], (3, count))
        force = force + weight
        about = about + _cross(origin[i] + _times(rotation[i], chain.cog[i]), weight)
        moment = about - _cross(origin[i], force)
        z, lever = rotation[i][:, 2], tcp - origin[i]
        axial = z * (z * moment).sum(axis=0)
        A[i] = _cross(axial, lever)
        A[n + i] = _cross(moment - axial, lever)
