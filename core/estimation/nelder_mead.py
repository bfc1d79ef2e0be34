"""The downhill simplex of scipy's ``minimize(method="Nelder-Mead")``, without its import time.

Source: Nelder, Mead, "A Simplex Method for Function Minimization", Computer Journal 7 (1965) 308.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapbridge.core.arrays import Array

FIRST, FIRST_FROM_ZERO = 0.05, 0.00025  # edges of the first simplex, as shares and of what is zero


def nelder_mead(
    function: Callable[[Array], float], start: Array, most: int,
    near: float = 1e-4, alike: float = 1e-4,
) -> tuple[Array, float]:  # fmt: skip
    """Return a local minimum (d,) of a function, near ``start``, and its value.

    Ends after ``most`` steps, or where all corners are within ``near`` of the best and their values
    within ``alike`` of its.
    """
    corners = np.tile(np.asarray(start, dtype=float), (len(start) + 1, 1))
    for k in range(len(start)):
        corners[k + 1, k] = (1 + FIRST) * start[k] if start[k] else FIRST_FROM_ZERO
    values = np.array([function(corner) for corner in corners])
    corners, values = _sorted(corners, values)
    for _ in range(most - 1):
        spread = float(np.abs(corners[1:] - corners[0]).max())
        if spread <= near and float(np.abs(values[1:] - values[0]).max()) <= alike:
            break
        _step(function, corners, values)
        corners, values = _sorted(corners, values)
    return corners[0], float(values[0])


def _sorted(corners: Array, values: Array) -> tuple[Array, Array]:
    order = np.argsort(values)
    return corners[order], values[order]


def _step(function: Callable[[Array], float], corners: Array, values: Array) -> None:
    """Move the worst corner: reflected, farther, or back; else all towards the best."""
    middle, worst = np.add.reduce(corners[:-1], 0) / (len(corners) - 1), corners[-1].copy()
    reflected = 2 * middle - worst
    there = function(reflected)
    if there < values[0]:
        farther = 3 * middle - 2 * worst
        value = function(farther)
        better = value < there
        corners[-1], values[-1] = (farther, value) if better else (reflected, there)
        return
    if there < values[-2]:
        corners[-1], values[-1] = reflected, there
        return
    outside = there < values[-1]
    back = 1.5 * middle - 0.5 * worst if outside else 0.5 * middle + 0.5 * worst
    value = function(back)
    if value <= there if outside else value < values[-1]:
        corners[-1], values[-1] = back, value
        return
    for j in range(1, len(corners)):
        corners[j] = corners[0] + 0.5 * (corners[j] - corners[0])
        values[j] = function(corners[j])
