"""Flexibilities from rows that are never stored: the plain linear fit of the paper's eq. 35.

Normal equations, their columns scaled to one length, add up block by block; where the scaled
condition would cost digits, the R factor is taken instead, and that is reported. What is needed
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
from gapbridge.core.kernels.factor import factor_blocks, normal_blocks
from gapbridge.core.kernels.layout import LANES
from gapbridge.core.kernels.reference import Rows
from gapbridge.core.kernels.threads import in_ranges
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

Array = NDArray[np.float64]
CHUNK = 128 * LANES  # rows that are brought into one form at once
WORST = 1e3  # scaled condition up to which the normal equations keep ten digits
UNSEEN = 1e-12  # share of the largest direction below which nothing is shown


@dataclass(frozen=True)
class LinearFit:
    """What the least squares found."""

    flexibility: Array  # (2n,) rad/Nm, axial then radial; zero where the rows do not show it
    condition: float  # of the columns scaled to one length, over the directions that are shown
    rank: int  # directions that are shown
    factored: bool  # the R factor was taken
    note: str  # a warning, or nothing


def fit_linear(
    model: Model, q: Array, loads: Loads, gap: Array, *, factored: bool | None = None
) -> LinearFit:
    """Return the flexibilities that best explain ``gap`` (N, 3 or 6), of one weight each.

    Columns at the model's present shape. ``factored`` True or False settles the way. Raises
    InputError where links bend themselves, or a row finds no equilibrium.
    """
    if model.chain().flexibility.any():
        raise InputError("linear fit: found a link that bends itself, expected stiff links")
    size = 2 * model.arm.n
    if not factored:
        G = np.tril(_summed(model, q, loads, gap, normal=True)[: size + 1, : size + 1])
        whole = G + np.tril(G, -1).T
        length = np.sqrt(np.diag(whole)[:size])
        unit = np.divide(1.0, length, out=np.zeros(size), where=length > 0)
        values, vectors = np.linalg.eigh(whole[:size, :size] * np.outer(unit, unit))
        shown = values > max(values[-1], 1e-300) * UNSEEN
        condition = float(np.sqrt(values[-1] / values[shown][0])) if shown.any() else 1.0
        if factored is False or condition < WORST:
            turned = vectors[:, shown]
            right = turned.T @ (unit * whole[size, :size])
            found = unit * (turned @ (right / values[shown]))
            return LinearFit(found, condition, int(shown.sum()), False, "")
    R = _summed(model, q, loads, gap, normal=False)
    length = np.linalg.norm(R[:, :size], axis=0)
    unit = np.divide(1.0, length, out=np.zeros(size), where=length > 0)
    U, s, Vt = np.linalg.svd(R[:, :size] * unit)
    shown = s > max(s[0], 1e-300) * UNSEEN
    found = unit * (Vt[shown].T @ ((U.T @ R[:, size])[:size][shown] / s[shown]))
    condition = float(s[0] / s[shown][-1]) if shown.any() else 1.0
    note = (
        f"the rows hardly separate some flexibilities (condition {condition:.0f}): the normal "
        "equations were left for the R factor"
    )
    return LinearFit(found, condition, int(shown.sum()), True, "" if factored else note)


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
        plain.growth,
        view(loads.payload_mass, plain.payload_mass, part),
        view(loads.payload_cog, plain.payload_cog, part),
        view(loads.wrench, plain.wrench, part),
    )


def _summed(model: Model, q: Array, loads: Loads, gap: Array, *, normal: bool) -> Array:
    """Return the normal matrix (lower tiles) or the R factor of [regressor | gap]."""
    chain, columns = model.chain(), 2 * model.arm.n + 1
    size = -(-columns // 4) * 4 if normal else columns
    total, lock = np.zeros((size, size)), threading.Lock()
    ones = np.ones((min(CHUNK, len(q)), gap.shape[1]))
    given = _views(model, q, loads)

    def work(first: int, last: int) -> None:
        own = np.zeros((size, size))
        for at in range(first, last, CHUNK):
            part = slice(at, min(at + CHUNK, last))
            count = part.stop - at
            rows, right = given(part), np.ascontiguousarray(gap[part])
            if normal:
                bad = normal_blocks(chain, rows, right, 0, count, own)
            else:
                bad = factor_blocks(chain, rows, right, ones, 0, 0, count, own)
            if bad >= 0:
                raise InputError(f"row {at + bad + 1}: the arm finds no equilibrium under its load")
        with lock:
            if normal:
                total[:] += own
            else:
                total[:] = np.linalg.qr(np.vstack([total, own]), mode="r")

    in_ranges(work, len(q))
    return total
