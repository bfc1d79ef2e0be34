"""Flexibilities from rows that are never stored: the plain linear fit of the paper's eq. 35.

The R factor adds up block by block, by the loop that ``gapbridge fit`` runs on. What is needed
besides the inputs does not grow with the rows. For logs with outliers, unregistered instruments or
bounds there is core.estimation.identification.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.errors import InputError
from gapbridge.core.kernels.factor import factor_blocks
from gapbridge.core.kernels.layout import LANES
from gapbridge.core.kernels.reference import Rows
from gapbridge.core.kernels.threads import in_ranges
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

Array = NDArray[np.float64]
CHUNK = 128 * LANES  # rows that are brought into one form at once
UNSEEN = 1e-12  # share of the largest direction below which nothing is shown


@dataclass(frozen=True)
class LinearFit:
    """What the least squares found."""

    flexibility: Array  # (2n,) rad/Nm, axial then radial; zero where the rows do not show it
    condition: float  # of the columns scaled to one length, over the directions that are shown
    rank: int  # directions that are shown


def fit_linear(model: Model, q: Array, loads: Loads, gap: Array) -> LinearFit:
    """Return the flexibilities that best explain ``gap`` (N, 3 or 6), of one weight each.

    Columns at the model's present shape. Raises InputError where links bend themselves, or a row
    finds no equilibrium.
    """
    if model.chain().flexibility.any():
        raise InputError("linear fit: found a link that bends itself, expected stiff links")
    size = 2 * model.arm.n
    R = _factored(model, q, loads, gap)
    length = np.linalg.norm(R[:, :size], axis=0)
    unit = np.divide(1.0, length, out=np.zeros(size), where=length > 0)
    U, s, Vt = np.linalg.svd(R[:, :size] * unit)
    shown = s > max(s[0], 1e-300) * UNSEEN
    found = unit * (Vt[shown].T @ ((U.T @ R[:, size])[:size][shown] / s[shown]))
    condition = float(s[0] / s[shown][-1]) if shown.any() else 1.0
    return LinearFit(found, condition, int(shown.sum()))


def _views(model: Model, q: Array, loads: Loads) -> Callable[[slice], Rows]:
    """Return what gives a part of the rows: views, where no effect changes them row by row."""
    if model.conditions():
        return lambda part: model.rows(q[part], loads[part])
    plain = model.rows(np.zeros((1, model.arm.n)))

    def view(column: Array | None, same: Array, part: slice) -> Array:
        if column is None:
            return same
        return np.ascontiguousarray(column[part], dtype=float)

    return lambda part: Rows(
        view(q, plain.q, part),
        plain.link_scale,
        view(loads.payload_mass, plain.payload_mass, part),
        view(loads.payload_cog, plain.payload_cog, part),
        view(loads.wrench, plain.wrench, part),
    )


def _factored(model: Model, q: Array, loads: Loads, gap: Array) -> Array:
    """Return the R factor of [regressor | gap]."""
    chain, size = model.chain(), 2 * model.arm.n + 1
    total, lock = np.zeros((size, size)), threading.Lock()
    ones = np.ones((min(CHUNK, len(q)), gap.shape[1]))
    given = _views(model, q, loads)

    def work(first: int, last: int) -> None:
        own = np.zeros((size, size))
        for at in range(first, last, CHUNK):
            part = slice(at, min(at + CHUNK, last))
            rows, right = given(part), np.ascontiguousarray(gap[part])
            bad = factor_blocks(chain, rows, right, ones, 0, part.stop - at, own)
            if bad >= 0:
                raise InputError(f"row {at + bad + 1}: the arm finds no equilibrium under its load")
        with lock:
            total[:] = np.linalg.qr(np.vstack([total, own]), mode="r")

    in_ranges(work, len(q))
    return total
