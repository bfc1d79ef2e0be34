"""Fixed points of the cell, from distances or spheres fitted to target positions."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.estimation.registration import Registration

TINY = 1e-9  # m, smallest distance with a defined direction


def fixed_at(point: Array) -> Registration:
    """Return a place whose origin is at a point (3,) of base."""
    return Registration(np.eye(3), -np.asarray(point, dtype=float))


def point_of(place: Registration) -> Array:
    """Return where the origin of a place is in base (3,)."""
    return np.asarray(place.in_base(np.zeros((1, 3)))[0])


def trilaterated(position: Array, distance: Array) -> Array:
    """Return the point (3,) at given distances (N,) from positions (N, 3), by linear least squares.

    |p - c|^2 = d^2 is linear in c with |c|^2 as a fourth unknown.
    """
    middle = position.mean(axis=0)
    p = position - middle
    A = np.column_stack([2 * p, -np.ones(len(p))])
    right = np.sum(p**2, axis=1) - distance**2
    return np.asarray(np.linalg.lstsq(A, right, rcond=1e-9)[0][:3] + middle)


def fitted_sphere(position: Array) -> tuple[Array, float]:
    """Return centre (3,) and radius of the sphere nearest to positions (N, 3), least squares."""
    middle = position.mean(axis=0)
    p = position - middle
    A = np.column_stack([2 * p, np.ones(len(p))])
    found = np.linalg.lstsq(A, np.sum(p**2, axis=1), rcond=1e-9)[0]
    radius = float(np.sqrt(max(found[3] + found[:3] @ found[:3], 0.0)))
    return found[:3] + middle, radius
