"""The same mechanics in plain numpy: what the compiled loops are compared with, and no more.

All rows at once, one array per quantity; written from the paper's equations, not from the compiled
loops. Rigid links; joints bend by their compliance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.kernels.reference import Chain, Rows

Array = NDArray[np.float64]
ROUNDS = 60


class Plain(NamedTuple):
    """Poses and linear form of N rows."""

    position: Array  # (N, 3) m
    rotation: Array  # (N, 3, 3)
    regressor: Array  # (N, 6, 2n)
    jacobian: Array  # (N, 6, n)
    moment: Array  # (N, n, 3)


def _turned(vector: Array) -> Array:
    """Return rotation matrices (N, 3, 3) of rotation vectors (N, 3): Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=1)[:, None, None]
    x, y, z = vector.T
    zero = np.zeros(len(vector))
    K = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2  # (1 - cos a) / a2
    return np.asarray(np.eye(3) + first * K + second * (K @ K))


def solve(chain: Chain, rows: Rows) -> Plain:
    """Return poses and linear form at the equilibrium of every row."""
    count, n = rows.q.shape
    bend, base_rotation = np.zeros((count, n, 3)), np.zeros((count, 3))
    for _ in range(ROUNDS):
        frames = _placed(chain, rows, bend, base_rotation)
        moment, base_moment = _loaded(chain, rows, frames)
        local = np.einsum("nikc,nik->nic", frames["rotation"], moment)
        new = chain.compliance * local
        new[:, :, 2] /= np.sqrt(1 + chain.softening * local[:, :, 2] ** 2)
        new_base_rotation = chain.base_compliance * base_moment
        change = max(np.abs(new - bend).max(), np.abs(new_base_rotation - base_rotation).max())
        bend, base_rotation = new, new_base_rotation
        if change < 1e-15:
            break
    tcp, z = frames["tcp"], frames["rotation"][:, :, :, 2]
    lever = tcp[:, None] - frames["origin"]
    axial = z * np.sum(z * moment, axis=2, keepdims=True)
    turning = np.concatenate([axial, moment - axial], axis=1)  # (N, 2n, 3)
    shift = np.cross(turning, np.concatenate([lever, lever], axis=1))
    axis = frames["axis"]
    jacobian = np.concatenate([np.cross(axis, lever), axis], axis=2)
    return Plain(
        tcp, frames["tcp_rotation"],
        np.concatenate([shift, turning], axis=2).transpose(0, 2, 1),
        jacobian.transpose(0, 2, 1), moment,
    )  # fmt: skip


def _placed(chain: Chain, rows: Rows, bend: Array, base_rotation: Array) -> dict[str, Array]:
    count, n = rows.q.shape
    R, o = _turned(base_rotation), np.zeros((count, 3))
    origin, rotation, axis = np.empty((count, n, 3)), np.empty((count, n, 3, 3)), []
    for i in range(n):
        length = rows.link_scale[:, i - 1, None] if i else 1.0
        o = o + np.einsum("nij,nj->ni", R, length * np.tile(chain.position[i], (count, 1)))
        c, s, zero = np.cos(rows.q[:, i]), np.sin(rows.q[:, i]), np.zeros(count)
        about_z = np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1]])
        R = R @ chain.rotation[i] @ about_z.transpose(2, 0, 1)
        axis.append(R[:, :, 2])
        R = R @ _turned(bend[:, i])
        origin[:, i], rotation[:, i] = o, R
    o = o + np.einsum("nij,nj->ni", R, rows.link_scale[:, n - 1, None] * chain.position[n])
    R = R @ chain.rotation[n]
    return {
        "origin": origin, "rotation": rotation, "axis": np.stack(axis, axis=1),
        "flange": o, "flange_rotation": R, "tcp": o + R @ chain.tool_position,
        "tcp_rotation": R @ chain.tool_rotation,
    }  # fmt: skip


def _loaded(chain: Chain, rows: Rows, frames: dict[str, Array]) -> tuple[Array, Array]:
    """Return the moments (N, n, 3) at the joints of everything beyond, and (N, 3) at the base."""
    n = rows.q.shape[1]
    held = frames["flange"] + np.einsum("nij,nj->ni", frames["flange_rotation"], rows.payload_cog)
    weight = rows.payload_mass[:, None] * chain.gravity
    force = rows.wrench[:, :3] + weight
    about_base = (
        rows.wrench[:, 3:] + np.cross(frames["tcp"], rows.wrench[:, :3]) + np.cross(held, weight)
    )
    moment = np.empty((len(rows.q), n, 3))
    for i in range(n - 1, -1, -1):
        place = frames["origin"][:, i] + frames["rotation"][:, i] @ chain.cog[i]
        weight = np.tile(chain.mass[i] * chain.gravity, (len(place), 1))
        force = force + weight
        about_base = about_base + np.cross(place, weight)
        moment[:, i] = about_base - np.cross(frames["origin"][:, i], force)
    return moment, about_base
