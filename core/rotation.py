"""Rotations as matrices and as rotation vectors, many rows at once."""

from __future__ import annotations

from math import sin, sqrt

import numpy as np

from gapbridge.core.arrays import Array


def rotation_matrix(rotation_vector: Array) -> Array:
    """Return the rotation matrices of rotation vectors (Rodrigues' formula; paper eq. 19).

    ``rotation_vector`` is (..., 3) in rad; the result (..., 3, 3).
    """
    vector = np.asarray(rotation_vector, dtype=float)
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    K = skew(vector)
    # sin(x)/x and (1 - cos(x))/x^2 through sinc: exact at zero, no division
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.asarray(np.eye(3) + first * K + second * (K @ K))


def one_rotation_matrix(vector: Array) -> Array:
    """Return the matrix (3, 3) of one rotation vector (3,), in plain numbers.

    Ten times as fast as ``rotation_matrix``, equal to it within rounding.
    """
    x, y, z = vector.tolist()
    square = x * x + y * y + z * z
    angle = sqrt(square)
    first = sin(angle) / angle if angle > 1e-8 else 1.0
    half = sin(angle / 2) / angle if angle > 1e-8 else 0.5
    c = 2 * half * half
    return np.array([
        [1 - c * (y * y + z * z), c * x * y - first * z, c * x * z + first * y],
        [c * x * y + first * z, 1 - c * (x * x + z * z), c * y * z - first * x],
        [c * x * z - first * y, c * y * z + first * x, 1 - c * (x * x + y * y)],
    ])  # fmt: skip


def left_jacobian(vector: Array) -> Array:
    """Return J (3, 3): exp(v + dv) = exp(J dv) exp(v) to first order; ``vector`` v (3,) in rad."""
    K = skew(vector)
    square = float(np.dot(vector, vector))
    angle = sqrt(square)
    if angle < 1e-3:
        second, third = 0.5 - square / 24, 1 / 6 - square / 120
    else:
        second, third = (
            2 * (sin(angle / 2) / angle) ** 2,
            (angle - sin(angle)) / (angle * square),
        )
    return np.asarray(np.eye(3) + second * K + third * (K @ K))


def rotation_vector(matrix: Array) -> Array:
    """Return the rotation vectors (..., 3), angle in [0, pi], of rotation matrices (..., 3, 3)."""
    from gapbridge.core.kernels.turns import rotation_vectors

    R = np.ascontiguousarray(matrix, dtype=float)
    vectors = np.empty(R.shape[:-1])
    rotation_vectors(R.reshape(-1, 3, 3), vectors.reshape(-1, 3))
    return vectors


def nearest_turn(angles: Array, others: Array) -> Array:
    """Return angles (any shape), rad, moved by whole turns to within half a turn of others."""
    turn = 2 * np.pi
    return np.asarray(angles + turn * np.round((others - angles) / turn))


def mean_rotation(vectors: Array) -> Array:
    """Return the mean rotation (3,) of close rotation vectors (N, 3), rad, by their matrices."""
    U, _, Vt = np.linalg.svd(rotation_matrix(vectors).mean(axis=0))
    return rotation_vector(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def skew(vector: Array) -> Array:
    """Return the matrices (..., 3, 3) whose product with b is vector (..., 3) x b."""
    v = np.asarray(vector, dtype=float)
    out = np.zeros((*v.shape, 3))
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def transform(rotation: Array, position: Array) -> Array:
    """Return one homogeneous transform (4, 4) of a rotation (3, 3) and a position (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = position
    return T


def rpy_matrix(roll_pitch_yaw: Array) -> Array:
    """Return the rotation matrix (3, 3) of fixed-axis roll, pitch, yaw (rad), as URDF has them."""
    roll, pitch, yaw = (float(v) for v in roll_pitch_yaw)
    return np.asarray(
        rotation_matrix(np.array([0, 0, yaw]))
        @ rotation_matrix(np.array([0, pitch, 0]))
        @ rotation_matrix(np.array([roll, 0, 0]))
    )


def roll_pitch_yaw(matrix: Array) -> Array:
    """Return roll, pitch, yaw (3,) in rad of a rotation (3, 3), as URDF has them; see rpy_matrix.

    At a pitch of a right angle, where only their sum is defined, yaw is zero.
    """
    level = float(np.hypot(matrix[0, 0], matrix[1, 0]))
    pitch = np.arctan2(-matrix[2, 0], level)
    if level < 1e-9:
        return np.array([np.arctan2(-matrix[1, 2], matrix[1, 1]), pitch, 0.0])
    roll, yaw = np.arctan2(matrix[2, 1], matrix[2, 2]), np.arctan2(matrix[1, 0], matrix[0, 0])
    return np.array([roll, pitch, yaw])
