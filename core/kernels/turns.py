"""Rotation vectors of many rotation matrices, in one pass over them."""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.reference import JIT


@njit(**JIT)
def rotation_vectors(R, vectors):  # type: ignore[no-untyped-def]
    """Write the rotation vectors (N, 3), angle in [0, pi], of matrices (N, 3, 3).

    By the quaternion's largest component: accurate at 0 and at pi.
    """
    squares, quaternion = np.empty(4), np.empty(4)
    for r in range(R.shape[0]):
        m = R[r]
        trace = m[0, 0] + m[1, 1] + m[2, 2]
        squares[0] = 1.0 + trace
        best = 0
        for k in range(3):
            squares[k + 1] = 1.0 + 2.0 * m[k, k] - trace
            if squares[k + 1] > squares[best]:
                best = k + 1
        quaternion[best] = squares[best]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            if best == 0:
                quaternion[k + 1] = m[j, i] - m[i, j]
            elif best == k + 1:
                quaternion[0] = m[j, i] - m[i, j]
            else:
                quaternion[k + 1] = m[best - 1, k] + m[k, best - 1]
        square = 0.0
        for k in range(4):
            square += quaternion[k] * quaternion[k]
        norm = np.sqrt(square) if quaternion[0] >= 0.0 else -np.sqrt(square)
        w, x = quaternion[0] / norm, quaternion[1] / norm
        y, z = quaternion[2] / norm, quaternion[3] / norm
        sine = np.sqrt(x * x + y * y + z * z)
        scale = 2.0 * np.arctan2(sine, w) / sine if sine > 1e-12 else 2.0
        vectors[r, 0], vectors[r, 1], vectors[r, 2] = scale * x, scale * y, scale * z
