"""The least squares of core.estimation.compliance_fit over rows that pass by in pieces.

Each step of Gauss and Newton passes once over the rows: the gap of every block weighs it, and the
block is folded into the R factor of all weighed columns (core.kernels), a factor for each fold.
What is noise and what an outlier the sample says, whose median stands for that of all rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.estimation.compliance_fit import (
    RANK,
    Data,
    Fit,
    add_rows,
    fold_rows,
    moved,
    noise_of,
    per_cell_of,
    residual,
    weights_at,
)
from gapbridge.core.estimation.held_out import FOLDS
from gapbridge.core.estimation.least_squares import solve

NONE = np.zeros(0)  # weights of a fit whose rows nobody keeps


@dataclass(frozen=True)
class Piece:
    """Some rows with measured poses, where they stand in the log, and in which folds."""

    data: Data
    rows: NDArray[np.int64]  # (k,) row in the log, from 0
    folds: tuple[tuple[int, slice], ...]


@dataclass(frozen=True)
class Pass:
    """What one pass over all rows has found at the shape of a fit."""

    factors: Array  # (FOLDS, k, k) R factors of each fold's rows
    inlier: list[Mask]  # piece by piece
    square: float  # m2, sum over the inliers' gaps of position


@dataclass(frozen=True)
class Stream:
    """All rows, piece by piece, as often as asked for."""

    pieces: Callable[[], Iterator[Piece]]
    sample: Data  # rows from all over the log, few enough to be kept
    fold: NDArray[np.int64]  # (S,) of the sample's rows
    count: int  # rows with measured poses
    width: int  # numbers per row: 3, or 6 with rotations
    nuisances: int

    def of_sample(self) -> Stream:
        """Return the sample alone, a piece for each fold."""
        rows = [np.flatnonzero(self.fold == k) for k in range(FOLDS)]
        pieces = [
            Piece(self.sample.part(own), own, ((k, slice(None)),))
            for k, own in enumerate(rows) if len(own)
        ]  # fmt: skip
        return replace(self, pieces=lambda: iter(pieces), count=len(self.fold))


def stretches(number: int, rows: int) -> Iterator[tuple[int, slice]]:
    """Yield each fold's rows of a piece, by its number: neighbours go together."""
    edges = np.linspace(0, rows, FOLDS + 1).astype(int)
    for k in range(FOLDS):
        if edges[k + 1] > edges[k]:
            yield (number + k) % FOLDS, slice(int(edges[k]), int(edges[k + 1]))


def scale_of(fit: Fit, sample: Data) -> Array:
    """Return the noise (2,), m and rad, by the gaps of the sample."""
    return noise_of(residual(fit.model, sample, fit.frame)[0])


def passed(fit: Fit, scale: Array, stream: Stream) -> Pass:
    """Return the R factors of [nuisances | flexibilities | gap] of each fold's rows.

    Columns at the shape of ``fit``, rows weighed by the noise ``scale`` (2,).
    """
    k = stream.nuisances + 2 * fit.model.arm.n + 1
    found, inliers, square = np.zeros((FOLDS, k, k)), list[Mask](), 0.0
    for piece in stream.pieces():
        gap, _ = residual(fit.model, piece.data, fit.frame)
        weights = weights_at(gap, scale)
        cells = per_cell_of(weights, scale, stream.width)
        for fold, rows in piece.folds:
            add_rows(fit.model, piece.data.part(rows), gap[rows], cells[rows], found[fold])
        inliers.append(weights > 0)
        square += float(np.sum(gap[inliers[-1], :3] ** 2))
    return Pass(found, inliers, square)


def placed(fit: Fit, left: Array, F: Array) -> Fit:
    """Return the fit with its nuisances moved so that F @ step takes up what is ``left``."""
    if not F.shape[1]:
        return fit
    step = solve(F, left, rank=RANK)
    return Fit(*moved(fit.model, fit.frame, step), NONE)


def joined(factors: Array) -> Array:
    """Return the R factor (k, k) of all rows of several R factors (parts, k, k)."""
    R = np.zeros(factors.shape[1:])
    fold_rows(R, *factors)
    return R
