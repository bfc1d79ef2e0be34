"""Newton-Euler of many rows of a rigid chain: where its frames are, how they move, what they take.

Loops of core/dynamics.py, which says what frames, signs and the source of the equations are.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.kernels.reference import JIT, copy_matrix, copy_vector


@njit(inline="always", **JIT)
def _plus_cross(a, b, out):  # type: ignore[no-untyped-def]
    """Add a x b to ``out`` (3,)."""
    out[0] += a[1] * b[2] - a[2] * b[1]
    out[1] += a[2] * b[0] - a[0] * b[2]
    out[2] += a[0] * b[1] - a[1] * b[0]


@njit(inline="always", **JIT)
def _turned(R, vector, out):  # type: ignore[no-untyped-def]
    for i in range(3):
        out[i] = R[i, 0] * vector[0] + R[i, 1] * vector[1] + R[i, 2] * vector[2]


@njit(**JIT)
def frames_of_rows(chain, motion, frames):  # type: ignore[no-untyped-def]
    """Write the frames of N rows (core.dynamics.Frames); ``motion`` (3, N, n): q, qd, qdd."""
    n = motion.shape[2]
    origin, rotation, omega, alpha, acceleration = frames
    step, turn, frame = np.empty(3), np.empty(3), np.empty((3, 3))
    R, w, dw, o, a = np.empty((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    for r in range(motion.shape[1]):
        R[:] = 0.0
        R[0, 0] = R[1, 1] = R[2, 2] = 1.0
        w[:], dw[:], o[:], a[:] = 0.0, 0.0, 0.0, 0.0
        for i in range(n + 1):
            _turned(R, chain.position[i], step)
            turn[:] = 0.0
            _plus_cross(w, step, turn)
            o += step
            _plus_cross(dw, step, a)
            _plus_cross(w, turn, a)
            for j in range(3):
                for k in range(3):
                    frame[j, k] = (
                        R[j, 0] * chain.rotation[i, 0, k]
                        + R[j, 1] * chain.rotation[i, 1, k]
                        + R[j, 2] * chain.rotation[i, 2, k]
                    )
            copy_matrix(frame, R)
            if i < n:
                c, s = np.cos(motion[0, r, i]), np.sin(motion[0, r, i])
                axis = frame[:, 2]
                for j in range(3):
                    R[j, 0] = c * frame[j, 0] + s * frame[j, 1]
                    R[j, 1] = c * frame[j, 1] - s * frame[j, 0]
                turn[:] = 0.0
                _plus_cross(w, axis, turn)
                for j in range(3):
                    dw[j] += axis[j] * motion[2, r, i] + turn[j] * motion[1, r, i]
                    w[j] += axis[j] * motion[1, r, i]
                copy_vector(w, omega[r, i])
                copy_vector(dw, alpha[r, i])
            copy_vector(o, origin[r, i])
            copy_matrix(R, rotation[r, i])
            copy_vector(a, acceleration[r, i])


@njit(**JIT)
def about_axes(frames, point, force, moment, torque):  # type: ignore[no-untyped-def]
    """Write the torques (N, joints) about joint axes that hold ``force`` at ``point``, ``moment``.

    ``point``, ``force``, ``moment`` (N, 3): m, N, Nm, base axes.
    """
    origin, rotation = frames.origin, frames.rotation
    arm, whole = np.empty(3), np.empty(3)
    for r in range(torque.shape[0]):
        for j in range(torque.shape[1]):
            for k in range(3):
                arm[k] = point[r, k] - origin[r, j, k]
                whole[k] = moment[r, k]
            _plus_cross(arm, force[r], whole)
            torque[r, j] = (
                rotation[r, j, 0, 2] * whole[0]
                + rotation[r, j, 1, 2] * whole[1]
                + rotation[r, j, 2, 2] * whole[2]
            )


@njit(**JIT)
def taken_by_link(i, body, gravity, frames, point, force, moment):  # type: ignore[no-untyped-def]
    """Write the centre of gravity (N, 3) of link i (from 0), and its required force and moment.

    ``body`` (5, 3): its centre of gravity, its mass in the first of the second row, its inertia.
    """
    cog, mass, inertia = body[0], body[1, 0], body[2:]
    origin, rotation, omega, alpha, acceleration = frames
    away, turn, own, spun, taken = (
        np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    )  # fmt: skip
    for r in range(point.shape[0]):
        R, w, dw = rotation[r, i], omega[r, i], alpha[r, i]
        _turned(R, cog, away)
        turn[:] = 0.0
        _plus_cross(w, away, turn)
        for k in range(3):
            point[r, k] = origin[r, i, k] + away[k]
            own[k] = acceleration[r, i, k] - gravity[k]
        _plus_cross(dw, away, own)
        _plus_cross(w, turn, own)
        for k in range(3):
            force[r, k] = mass * own[k]
        # the inertia turns with the link: I w = R I_link (R^T w)
        for k in range(3):
            turn[k] = R[0, k] * w[0] + R[1, k] * w[1] + R[2, k] * w[2]
            own[k] = R[0, k] * dw[0] + R[1, k] * dw[1] + R[2, k] * dw[2]
        _turned(inertia, turn, spun)
        _turned(inertia, own, taken)
        _turned(R, spun, away)
        _turned(R, taken, own)
        _plus_cross(w, away, own)
        copy_vector(own, moment[r])
