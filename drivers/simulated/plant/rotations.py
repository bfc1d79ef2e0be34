"""Exact finite rotations and rigid transforms on plain tuples, for the 2 ms loop.

A rotation is nine numbers by rows, a vector three. Plain tuples beat arrays of this size by far.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

Vector3 = tuple[float, float, float]
Rotation = tuple[float, float, float, float, float, float, float, float, float]

IDENTITY: Rotation = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def compose(a: Rotation, b: Rotation) -> Rotation:
    """Return a b."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = a
    b0, b1, b2, b3, b4, b5, b6, b7, b8 = b
    return (
        a0 * b0 + a1 * b3 + a2 * b6,
        a0 * b1 + a1 * b4 + a2 * b7,
        a0 * b2 + a1 * b5 + a2 * b8,
        a3 * b0 + a4 * b3 + a5 * b6,
        a3 * b1 + a4 * b4 + a5 * b7,
        a3 * b2 + a4 * b5 + a5 * b8,
        a6 * b0 + a7 * b3 + a8 * b6,
        a6 * b1 + a7 * b4 + a8 * b7,
        a6 * b2 + a7 * b5 + a8 * b8,
    )


def turn_z(a: Rotation, angle: float) -> Rotation:
    """Return a Rz(angle)."""
    c, s = math.cos(angle), math.sin(angle)
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = a
    return (
        a0 * c + a1 * s, a1 * c - a0 * s, a2,
        a3 * c + a4 * s, a4 * c - a3 * s, a5,
        a6 * c + a7 * s, a7 * c - a6 * s, a8,
    )  # fmt: skip


def transpose(a: Rotation) -> Rotation:
    """Return the inverse of a."""
    return (a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8])


def rotate(a: Rotation, v: Sequence[float]) -> Vector3:
    """Return a v."""
    x, y, z = v
    return (
        a[0] * x + a[1] * y + a[2] * z,
        a[3] * x + a[4] * y + a[5] * z,
        a[6] * x + a[7] * y + a[8] * z,
    )


def unrotate(a: Rotation, v: Sequence[float]) -> Vector3:
    """Return a^T v."""
    x, y, z = v
    return (
        a[0] * x + a[3] * y + a[6] * z,
        a[1] * x + a[4] * y + a[7] * z,
        a[2] * x + a[5] * y + a[8] * z,
    )


def cross(a: Sequence[float], b: Sequence[float]) -> Vector3:
    """Return a x b."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def add(a: Sequence[float], b: Sequence[float]) -> Vector3:
    """Return a + b of two 3-vectors."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def subtract(a: Sequence[float], b: Sequence[float]) -> Vector3:
    """Return a - b of two 3-vectors."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scale(a: Sequence[float], factor: float) -> Vector3:
    """Return factor a of a 3-vector."""
    return (a[0] * factor, a[1] * factor, a[2] * factor)


def from_vector(v: Sequence[float]) -> Rotation:
    """Return the rotation of a rotation vector (rad)."""
    x, y, z = v
    squared = x * x + y * y + z * z
    angle = math.sqrt(squared)
    if angle < 1e-6:
        s, k = 1.0 - squared / 6.0, 0.5 - squared / 24.0
    else:
        s, k = math.sin(angle) / angle, (1.0 - math.cos(angle)) / squared
    return (
        1.0 - k * (y * y + z * z), k * x * y - s * z, k * x * z + s * y,
        k * x * y + s * z, 1.0 - k * (x * x + z * z), k * y * z - s * x,
        k * x * z - s * y, k * y * z + s * x, 1.0 - k * (x * x + y * y),
    )  # fmt: skip


def to_vector(a: Rotation) -> Vector3:
    """Return the rotation vector (rad, at most pi long) of a rotation."""
    x, y, z = a[7] - a[5], a[2] - a[6], a[3] - a[1]
    sine = math.sqrt(x * x + y * y + z * z)
    trace = a[0] + a[4] + a[8]
    angle = math.atan2(sine, trace - 1.0)
    if sine > 1e-6:
        k = angle / sine
        return (x * k, y * k, z * k)
    if trace > 0.0:
        return (x / 2.0, y / 2.0, z / 2.0)
    return _half_turn(a, (x, y, z), angle)


def _half_turn(a: Rotation, skew: Vector3, angle: float) -> Vector3:
    """Return the rotation vector of a rotation close to half a turn."""
    diagonal = (a[0], a[4], a[8])
    i = max(range(3), key=lambda n: diagonal[n])
    column = [a[i] + a[3 * i], a[3 + i] + a[3 * i + 1], a[6 + i] + a[3 * i + 2]]
    column[i] += 1.0 - diagonal[0] - diagonal[1] - diagonal[2]
    length = math.sqrt(sum(c * c for c in column))
    if sum(c * s for c, s in zip(column, skew, strict=True)) < 0.0:
        length = -length
    return (column[0] / length * angle, column[1] / length * angle, column[2] / length * angle)
