"""The least squares of core.estimation.compliance_fit over rows that pass by in pieces.

Each step of Gauss and Newton passes twice over the rows: once for the gap, whose median says what
is noise and what is an outlier, once for the R factor of all weighed columns, into which every
block of
rows is folded (core.kernels). What is kept does not grow with the rows; the gaps wait in a file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.estimation import compliance_fit
from gapbridge.core.estimation.compliance_fit import (
    CONVERGED,
    NUISANCE_ROUNDS,
    RANK,
    ROUNDS,
    Data,
    Fit,
    Mask,
    moved,
    noise_scale,
    nuisance_columns,
    per_cell_of,
    residual,
    stepped,
    weights_at,
)
from gapbridge.core.estimation.registration import IDENTITY
from gapbridge.core.estimation.spool import Spool
from gapbridge.core.kernels.factor import factor_blocks
from gapbridge.core.kernels.threads import in_ranges
from gapbridge.core.model import Model

Array = NDArray[np.float64]
NONE = np.zeros(0)  # weights of a fit whose rows nobody keeps


@dataclass(frozen=True)
class Piece:
    """Some rows with measured poses, and where they stand in the log."""

    data: Data
    rows: NDArray[np.int64]  # (k,) row in the log, from 0


@dataclass(frozen=True)
class Stream:
    """All rows, piece by piece, as often as asked for."""

    pieces: Callable[[], Iterator[Piece]]
    sample: Data  # rows from all over the log, few enough to be kept
    count: int  # rows with measured poses
    width: int  # numbers per row: 3, or 6 with rotations
    nuisances: int


@dataclass(frozen=True)
class FitState:
    """A fit, and the noise by which its rows were weighed."""

    fit: Fit
    scale: Array  # (2,) m, rad


def fit_nuisances(model: Model, stream: Stream) -> FitState:
    """Return the frame and tool point that fit best, the model's flexibilities left alone."""
    if not stream.nuisances:
        fit = Fit(model, IDENTITY, NONE)
        with _gaps(fit, stream) as gaps:
            return FitState(fit, _scale(gaps))
    begin = compliance_fit.fit_nuisances(model, stream.sample)
    fit = Fit(begin.model, begin.frame, NONE)
    for _ in range(NUISANCE_ROUNDS):
        scale, R = weighed(fit, stream)
        step = np.linalg.lstsq(R[:, :9], R[:, -1], rcond=RANK)[0]
        fit = Fit(*moved(fit.model, fit.frame, step), NONE)
        if np.abs(step).max() < CONVERGED:
            break
    return FitState(fit, scale)


def fit_flexibilities(
    begin: FitState, stream: Stream, kept: Mask, prior: tuple[Array, float], *,
    nonnegative: bool, rounds: int = ROUNDS,
) -> FitState:  # fmt: skip
    """Return the fit of the ``kept`` flexibilities, as ``compliance_fit.fit_flexibilities``."""
    now = begin
    for _ in range(rounds):
        before = now.fit.flexibility
        scale, R = weighed(now.fit, stream)
        m = stream.nuisances
        problem = (R[:, :m], R[:, m:-1], R[:, -1])
        fit = stepped(now.fit, problem, NONE, kept, prior, nonnegative=nonnegative)
        now = FitState(fit, scale)
        if np.abs(fit.flexibility - before).max() < CONVERGED * max(np.abs(before).max(), 1e-12):
            break
    return now


def weighed(fit: Fit, stream: Stream) -> tuple[Array, Array]:
    """Return the noise (2,) and the R factor (k, k) of [nuisances | flexibilities | gap]."""
    k = stream.nuisances + 2 * fit.model.arm.n + 1
    R = np.zeros((k, k))
    with _gaps(fit, stream) as gaps:
        scale = _scale(gaps)
        gaps.rewind()
        for piece in stream.pieces():
            gap = gaps.read(len(piece.rows))
            cells = per_cell_of(weights_at(gap, scale), scale, stream.width)
            add_rows(fit.model, piece.data, gap, cells, R)
    return scale, R


def factors(
    settled: FitState,
    stream: Stream,
    part_of: Callable[[NDArray[np.int64]], NDArray[np.int64]],
    parts: int,
) -> Array:
    """Return the R factors (parts, k, k) of the rows of each part, at a fit's shape and weights.

    ``part_of`` returns the part, from 0, of rows by their numbers.
    """
    fit, scale = settled.fit, settled.scale
    k = stream.nuisances + 2 * fit.model.arm.n + 1
    found = np.zeros((parts, k, k))
    for piece in stream.pieces():
        gap, _ = residual(fit.model, piece.data, fit.frame)
        cells = per_cell_of(weights_at(gap, scale), scale, stream.width)
        part = part_of(piece.rows)
        for p in range(parts):
            own = np.flatnonzero(part == p)
            if len(own):
                add_rows(fit.model, piece.data.part(own), gap[own], cells[own], found[p])
    return found


def joined(factors: Array) -> Array:
    """Return the R factor (k, k) of all rows of several R factors (parts, k, k)."""
    R = np.zeros(factors.shape[1:])
    _fold(R, *factors)
    return R


def add_rows(model: Model, data: Data, gap: Array, cells: Array, R: Array) -> None:
    """Fold rows into R: columns at the model's shape, ``gap`` and factors ``cells`` (N, width)."""
    chain, rows = model.chain(), model.rows(data.q, data.loads)
    nuisances, stopped = data.nuisances, [0]
    if not chain.flexibility.any():
        parts: list[Array] = []

        def work(first: int, last: int) -> int:
            own = np.zeros_like(R)
            parts.append(own)
            return int(factor_blocks(chain, rows, gap, cells, nuisances, first, last, own))

        stopped = in_ranges(work, len(gap))
        if max(stopped) < 0:
            _fold(R, *parts)
            return
    # something bends too far for blocks, or the links themselves do: columns in memory
    width = gap.shape[1]
    columns = [model.linear_form(data.q, data.loads).regressor[:, :width], gap[..., None]]
    if nuisances:
        columns.insert(0, nuisance_columns(model, model.predict(data.q, data.loads), width))
    stored = np.concatenate(columns, axis=2) * cells[..., None]
    _fold(R, stored.reshape(-1, len(R)))


def _fold(R: Array, *parts: Array) -> None:
    folded = np.linalg.qr(np.vstack([R, *parts]), mode="r")
    R[:] = 0.0
    R[: len(folded)] = folded


def _gaps(fit: Fit, stream: Stream) -> Spool:
    gaps = Spool(stream.width)
    for piece in stream.pieces():
        gaps.append(residual(fit.model, piece.data, fit.frame)[0])
    return gaps


def _scale(gaps: Spool) -> Array:
    turned = gaps.median_size(3, 6) if gaps.width > 3 else None
    return noise_scale(gaps.median_size(0, 3), turned)
