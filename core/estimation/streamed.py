"""Identification from logs of any length: read once, then passed over in blocks of rows.

The same least squares, weights and choice as identification.py, begun at the fit to a sample of the
rows. Held-out figures leave out every fifth row by chance, not whole poses: among many thousands of
rows, poses are not separated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.effects import CATALOGUE
from gapbridge.core.effects.effect import typical_moment
from gapbridge.core.estimation import base_parameters, compliance_fit
from gapbridge.core.estimation.compliance_fit import (
    RANK,
    Data,
    Fit,
    Mask,
    flexibilities,
    moved,
    residual,
    solve,
    stepped,
    weights_at,
)
from gapbridge.core.estimation.identification import (
    FOLDS,
    Identification,
    data_of,
    notes_of,
    require_excitation,
)
from gapbridge.core.estimation.row_store import RowStore
from gapbridge.core.estimation.streamed_fit import (
    NONE,
    FitState,
    Piece,
    Stream,
    factors,
    fit_flexibilities,
    fit_nuisances,
    joined,
)
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
SAMPLE = 20_000  # rows kept at most, for the first guess and the look whether anything bends
MANY_OUTLIERS = 100_000  # rows that are named at most
INLIER = 1e-6  # weight below which a row counts as an outlier


@dataclass(frozen=True)
class _Task:
    prior: tuple[Array, float]
    scale: float
    nonnegative: bool

    def on_sample(self, before: FitState, sample: Data) -> FitState:
        """Fit everything on the rows of the sample: where the passes over all rows begin."""
        centre = self.prior[0]
        fit = compliance_fit.fit_flexibilities(
            before.fit, sample, np.ones(len(centre), dtype=bool), self.prior,
            nonnegative=self.nonnegative,
        )  # fmt: skip
        return FitState(Fit(fit.model, fit.frame, NONE), before.scale)

    def run(self, begin: FitState, stream: Stream) -> tuple[FitState, base_parameters.Shown]:
        """Fit everything, choose what the data show, fit that alone."""
        centre = self.prior[0]
        everything = np.ones(len(centre), dtype=bool)
        look = fit_flexibilities(
            begin, stream, everything, self.prior, nonnegative=self.nonnegative, rounds=1
        )
        assert look.fit.linear is not None
        kept = self.choose(look.fit)
        values, n = np.where(kept, look.fit.flexibility, centre), len(centre) // 2
        model = look.fit.model.with_compliance(values[:n], values[n:])
        begin = FitState(Fit(model, look.fit.frame, NONE), look.scale)
        found = fit_flexibilities(begin, stream, kept, self.prior, nonnegative=self.nonnegative)
        assert found.fit.linear is not None
        return found, base_parameters.what_is_shown(found.fit.linear, kept, self.scale)

    def choose(self, look: Fit) -> Mask:
        """Return which flexibilities (2n,) the data show, by the linear form of a fit of all."""
        assert look.linear is not None
        return base_parameters.choose(look.linear, (self.prior[0], self.scale), self.nonnegative)

    def without(self, after: Fit, R: Array, nuisances: int) -> Fit:
        """Return the fit to some of the rows, one step from the fit to all: choice, then values.

        ``R`` is those rows' factor at the shape of ``after``.
        """
        F, A, b = R[:, :nuisances], R[:, nuisances:-1], R[:, -1]
        centre, n = self.prior[0], after.model.arm.n
        look = stepped(
            after, (F, A, b), NONE, np.ones(len(centre), dtype=bool), self.prior,
            nonnegative=self.nonnegative,
        )  # fmt: skip
        assert look.linear is not None
        kept = self.choose(look)
        begin = np.where(kept, after.flexibility, centre)
        found = solve(look.linear, kept, begin, self.prior, self.nonnegative)
        model, frame = after.model, after.frame
        if nuisances:
            left = b - A @ (found - after.flexibility)
            model, frame = moved(model, frame, np.linalg.lstsq(F, left, rcond=RANK)[0])
        return Fit(model.with_compliance(found[:n], found[n:]), frame, NONE)


def identify_streamed(
    model: Model,
    log: Iterable[Log],
    metrology: Metrology | None = None,
    *,
    nonnegative: bool = True,
    prior_std: float | None = None,
    held_out: bool = True,
    progress: Callable[[str], None] | None = None,
) -> Identification:
    """Return what ``identify_compliance`` does, for a log that comes in pieces.

    ``log`` is iterated over once (core.log.pieces.LogPieces, or a list of logs). ``held_out`` False
    spares the fits without a fold. Raises as ``identify_compliance``.
    """
    metrology = metrology or Metrology()
    emit = progress or (lambda text: None)
    emit("reading")
    stream = _stream(log, metrology, any(CATALOGUE[t.effect].by_approach for t in model.terms))
    usual = 1e-2 / typical_moment(model.arm)
    prior_std = usual if prior_std is None else prior_std
    require_excitation(model, stream.sample, metrology, min(prior_std, usual))
    scale = prior_std if np.isfinite(prior_std) else usual
    task = _Task((flexibilities(model), prior_std), scale, nonnegative)
    emit("fitting")
    before = fit_nuisances(model, stream)
    after, shown = task.run(task.on_sample(before, stream.sample), stream)
    unseen = (float("nan"), float("nan"))
    if held_out:
        emit("checking on held-out rows")
        unseen = _held_out(stream, task, before, after)
    return _result(model, stream, (before, after), shown, unseen)


def _stream(log: Iterable[Log], metrology: Metrology, by_approach: bool) -> Stream:
    """Return the rows with measured poses; passes once over the log."""
    store, first, empty = RowStore(), 0, None
    for part in log:
        data, used = data_of(part, metrology)
        if not by_approach:
            data = replace(data, loads=replace(data.loads, approach=None))
        if len(used):
            store.append(data, used + first)
        else:
            empty = data
        first += len(part)
    every = max(store.count // SAMPLE, 1)
    kept = [data.part(rows % every == 0) for data, rows in store]
    if not kept:  # no row at all: the usual way says so
        assert empty is not None
        kept = [empty]
    sample = _joined(kept)
    width = 3 if sample.rotation is None else 6

    def pieces() -> Iterator[Piece]:
        return (Piece(data, rows) for data, rows in store)

    return Stream(pieces, sample, store.count, width, sample.nuisances)


def _joined(parts: list[Data]) -> Data:
    def stacked(values: list[Array | None]) -> Array | None:
        given = [value for value in values if value is not None]
        return np.concatenate(given) if given else None

    loads = Loads(
        *(
            stacked([getattr(part.loads, name) for part in parts])
            for name in ("payload_mass", "payload_cog", "wrench", "temperature", "approach")
        )
    )
    return Data(
        np.concatenate([part.q for part in parts]),
        loads,
        np.concatenate([part.position for part in parts]),
        stacked([part.rotation for part in parts]),
        parts[0].registered,
    )


def fold_of(rows: Rows) -> Rows:
    """Return the fold (k,) that leaves out each row: by chance, the same at every pass."""
    x = rows.astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = (x ^ (x >> np.uint64(shift))) * np.uint64(factor)  # splitmix64 (Steele et al. 2014)
    return ((x ^ (x >> np.uint64(31))) % np.uint64(FOLDS)).astype(np.int64)


def _held_out(
    stream: Stream, task: _Task, before: FitState, after: FitState
) -> tuple[float, float]:
    """Return the rms before and after over inliers that each fit did not see.

    Fits without a fold are one step from the fits to all rows, whose shape and weights they share.
    """
    parts = [factors(one, stream, fold_of, FOLDS) for one in (before, after)]
    m, fits = stream.nuisances, []
    for k in range(FOLDS):
        rest = [joined(np.delete(R, k, axis=0)) for R in parts]
        first = before.fit
        if m:
            step = np.linalg.lstsq(rest[0][:, :m], rest[0][:, -1], rcond=RANK)[0]
            first = Fit(*moved(first.model, first.frame, step), NONE)
        fits.append((first, task.without(after.fit, rest[1], m)))
    sums, count = np.zeros(2), 0
    for piece in stream.pieces():
        fold, inlier = fold_of(piece.rows), _inliers(after, piece.data)
        for k in range(FOLDS):
            unseen = piece.data.part((fold == k) & inlier)
            gaps = [residual(fit.model, unseen, fit.frame)[0][:, :3] for fit in fits[k]]
            sums += [float(np.sum(gap**2)) for gap in gaps]
            count += gaps[0].size
    before_rms, after_rms = np.sqrt(sums / max(count, 1))
    return float(before_rms), float(after_rms)


def _inliers(settled: FitState, data: Data) -> Mask:
    gap = residual(settled.fit.model, data, settled.fit.frame)[0]
    return np.asarray(weights_at(gap, settled.scale) > INLIER)


def _result(
    model: Model, stream: Stream, fits: tuple[FitState, FitState], shown: base_parameters.Shown,
    held_out: tuple[float, float],
) -> Identification:  # fmt: skip
    n, kept, after = model.arm.n, shown.kept, fits[1].fit
    sums, inlier_cells, outliers = np.zeros(2), 0, list[Rows]()
    for piece in stream.pieces():
        gaps = [residual(one.fit.model, piece.data, one.fit.frame)[0] for one in fits]
        inlier = weights_at(gaps[1], fits[1].scale) > INLIER
        sums += [float(np.sum(gap[inlier, :3] ** 2)) for gap in gaps]
        inlier_cells += 3 * int(inlier.sum())
        outliers.append(piece.rows[~inlier])
    spent = np.array([stream.nuisances, stream.nuisances + int(kept.sum())])
    gap_rms, remaining_rms = np.sqrt(sums / np.maximum(inlier_cells - spent, 1))
    std, flexibility = np.sqrt(np.diag(shown.covariance)), after.flexibility
    count = stream.count - inlier_cells // 3
    named = np.fromiter(islice((row for rows in outliers for row in rows), MANY_OUTLIERS), np.int64)
    return Identification(
        after.model, flexibility[:n], flexibility[n:], std[:n], std[n:], shown.covariance, kept,
        shown.reported, after.frame,
        after.model.tool_in_flange[:3, 3] - model.tool_in_flange[:3, 3], stream.count,
        float(gap_rms), float(remaining_rms), *held_out, named,
        tuple(notes_of(after, kept, count, stream.nuisances)),
    )  # fmt: skip
