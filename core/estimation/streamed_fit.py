"""The least squares of core.estimation.compliance_fit over rows in blocks.

Each Gauss-Newton step is one pass over the rows: every block is weighted by its residuals and
folded into the R factor of all weighted columns (core.kernels), one factor per fold. The noise is
estimated from the sample.
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
    residual,
    with_step,
)
from gapbridge.core.estimation.held_out import FOLDS
from gapbridge.core.estimation.least_squares import solve
from gapbridge.core.estimation.robust import noise_of, weights_at, whitening_factors

NO_WEIGHTS = np.zeros(0)  # of a fit to rows that are not stored


@dataclass(frozen=True)
class Piece:
    """Some rows with measured poses, their row numbers and folds."""

    data: Data
    rows: NDArray[np.int64]  # (k,) row in the log, from 0
    folds: tuple[tuple[int, slice], ...]


@dataclass(frozen=True)
class Accumulated:
    """The sums of one pass over all rows, linearised at a fit."""

    factors: Array  # (FOLDS, k, k) R factors of each fold's rows
    inlier: list[Mask]  # piece by piece
    equations: float  # sum of their weights
    square: float  # m2, sum over the inliers' gaps of position


@dataclass(frozen=True)
class Stream:
    """All rows in pieces, which can be iterated repeatedly."""

    pieces: Callable[[], Iterator[Piece]]
    sample: Data  # rows from all over the log, few enough to be kept
    fold: NDArray[np.int64]  # (S,) of the sample's rows
    count: int  # rows with measured poses
    width: int  # numbers per row: 3, or 6 with rotations
    nuisances: int

    def sample_only(self) -> Stream:
        """Return the sample alone, a piece for each fold."""
        rows = [np.flatnonzero(self.fold == k) for k in range(FOLDS)]
        pieces = [
            Piece(self.sample.part(rows_of_fold), rows_of_fold, ((k, slice(None)),))
            for k, rows_of_fold in enumerate(rows) if len(rows_of_fold)
        ]  # fmt: skip
        return replace(self, pieces=lambda: iter(pieces), count=len(self.fold))


def fold_slices(number: int, rows: int) -> Iterator[tuple[int, slice]]:
    """Yield each fold's rows of a piece, by its number: neighbours go together."""
    edges = np.linspace(0, rows, FOLDS + 1).astype(int)
    for k in range(FOLDS):
        if edges[k + 1] > edges[k]:
            yield (number + k) % FOLDS, slice(int(edges[k]), int(edges[k + 1]))


def scale_of(fit: Fit, sample: Data) -> Array:
    """Return the noise (2,), m and rad, by the gaps of the sample."""
    return noise_of(residual(fit.model, sample, fit.frame)[0])


def accumulate(fit: Fit, scale: Array, stream: Stream) -> Accumulated:
    """Return the R factors of [nuisances | flexibilities | gap] of each fold's rows.

    Columns are linearised at ``fit``, rows weighted by the noise ``scale`` (2,), m and rad.
    """
    k = stream.nuisances + 2 * fit.model.arm.n + 1
    factors, inliers, square = np.zeros((FOLDS, k, k)), list[Mask](), 0.0
    equations = 0.0
    for piece in stream.pieces():
        gap, _ = residual(fit.model, piece.data, fit.frame)
        weights = weights_at(gap, scale)
        cells = whitening_factors(weights, scale, stream.width)
        for fold, rows in piece.folds:
            add_rows(fit.model, piece.data.part(rows), gap[rows], cells[rows], factors[fold])
        inliers.append(weights > 0)
        equations += stream.width * float(weights.sum())
        square += float(np.sum(gap[inliers[-1], :3] ** 2))
    return Accumulated(factors, inliers, equations, square)


def with_nuisance_step(fit: Fit, residual: Array, F: Array) -> Fit:
    """Return the fit with its nuisances moved by the step that solves F @ step = residual."""
    if not F.shape[1]:
        return fit
    step = solve(F, residual, rank=RANK)
    return Fit(*with_step(fit.model, fit.frame, step), NO_WEIGHTS)


def merged_factor(factors: Array) -> Array:
    """Return the R factor (k, k) of all rows of several R factors (parts, k, k)."""
    R = np.zeros(factors.shape[1:])
    fold_rows(R, *factors)
    return R
