"""The task of one setpoint in plain numpy."""

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
