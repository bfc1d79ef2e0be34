"""Identification from logs of any length: read once, then passed over in blocks of rows.

The same least squares, weights and choice as identification.py, begun at the fit to a sample of the
rows. Held-out figures leave out every fifth stretch of rows, not whole poses: among many thousands
of rows, poses are not separated. They are judged on the sample's rows, some twenty thousand.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.effects import at_moment, by_approach
from gapbridge.core.estimation import base_parameters
from gapbridge.core.estimation.compliance_fit import (
    CONVERGED,
    ROUNDS,
    Data,
    Fit,
    Linear,
    as_written,
    fit_flexibilities,
    fit_nuisances,
    prior_of,
    projected,
    residual,
    solve,
    stepped,
    weights_at,
    with_free_geometry,
)
from gapbridge.core.estimation.geometry import Geometry
from gapbridge.core.estimation.held_out import FOLDS
from gapbridge.core.estimation.identification import (
    Identification,
    data_of,
    notes_of,
    require_excitation,
    tool_known,
)
from gapbridge.core.estimation.pose_scatter import by_poses
from gapbridge.core.estimation.streamed_fit import (
    NONE,
    Pass,
    Piece,
    Stream,
    joined,
    passed,
    placed,
    scale_of,
    stretches,
)
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

KEPT = 128 << 20  # bytes in memory
Rows = NDArray[np.int64]
SAMPLE = 20_000  # rows kept at most, for the first guess and the look whether anything bends
MANY_OUTLIERS = 100_000  # rows that are named at most
ENOUGH = 0.2  # sigmas of a last step, which leaves some percent of itself, with many rows
LINK_ROWS = 2000  # of them that determine the links, where these are off
NEAR = 1e-3  # relative step on the sample, which is only where the passes over all rows begin


class RowStore:
    """Blocks of rows with measured poses, and where each row stands in the log."""

    def __init__(self, kept: int = KEPT) -> None:
        self.count = 0
        self._free = kept
        self._blocks: list[tuple[Data, NDArray[np.int64]]] = []
        self._file: Any = None

    def append(self, data: Data, rows: NDArray[np.int64]) -> None:
        """Keep a block; ``rows`` (k,) are the numbers of its rows, from 0."""
        given = {f.name: getattr(data.loads, f.name) for f in fields(Loads)}
        loads = Loads(**{k: None if v is None else self._kept(v) for k, v in given.items()})
        self._blocks.append((
            replace(
                data, q=self._kept(data.q), position=self._kept(data.position), loads=loads,
                rotation=None if data.rotation is None else self._kept(data.rotation),
            ),
            self._kept(rows),
        ))  # fmt: skip
        self.count += len(rows)

    def __iter__(self) -> Iterator[tuple[Data, NDArray[np.int64]]]:
        """Yield the blocks in the order in which they came."""
        return iter(self._blocks)

    def _kept(self, values: NDArray[Any]) -> NDArray[Any]:
        if (
            len(values) and (values == values[0]).all()
        ):  # one payload's centre: a row counts for all
            return np.broadcast_to(values[:1].copy(), values.shape)
        if values.nbytes <= self._free:
            self._free -= values.nbytes
            return values
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="gapbridge-")  # noqa: SIM115 - lives as long
        at = self._file.seek(0, 2)
        self._file.write(np.ascontiguousarray(values).tobytes())
        self._file.flush()
        return np.memmap(self._file, values.dtype, "r", at, values.shape)


@dataclass(frozen=True)
class _Task:
    prior: tuple[Array, float]

    def near(self, before: Fit, rows: Data) -> Fit:
        """Fit everything on some rows: where the passes over all rows begin."""
        everything = np.ones(len(self.prior[0]), dtype=bool)
        return fit_flexibilities(before, rows, everything, self.prior, converged=NEAR)

    def run(self, begin: Fit, stream: Stream) -> _Found:
        """Choose what all rows show, and fit that alone.

        A step that is small leaves an error of some percent of itself, by the weights: the steps
        need not become smaller than what so many rows determine anyway.
        """
        now, long = begin, stream.count > SAMPLE
        kept: Mask | None = None
        for _ in range(ROUNDS):
            noise = scale_of(now, stream.sample)
            rows = passed(now, noise, stream)
            found, kept, linear = self.step(now, joined(rows.factors), stream.nuisances, kept)
            change = np.abs(found.flexibility - now.flexibility)
            base, now = now, found
            if change.max() < CONVERGED * max(np.abs(now.flexibility).max(), 1e-12):
                break
            if long and (change[kept] < ENOUGH * _spread(linear, kept)).all():
                break
        assert kept is not None
        shown = base_parameters.what_is_shown(linear, kept, self.prior[1])
        return _Found(now, noise, base, rows, shown)

    def step(
        self, at: Fit, R: Array, nuisances: int, kept: Mask | None = None
    ) -> tuple[Fit, Mask, Linear]:
        """Return the fit one step from ``at``, what is kept (where not given) and the problem.

        ``R`` is the factor of the rows that are fitted, at the shape of ``at``.
        """
        F, A, b = R[:, :nuisances], R[:, nuisances:-1], R[:, -1]
        centre, n = self.prior[0], at.model.arm.n
        look = stepped(at, (F, A, b), NONE, np.ones(len(centre), dtype=bool), self.prior)
        linear = look.linear
        assert linear is not None
        if kept is None:
            kept = base_parameters.choose(linear, self.prior)
        begin = np.where(kept, at.flexibility, centre)
        found = solve(linear, kept, begin, self.prior)
        moved = placed(at, b - A @ (found - at.flexibility), F)
        return (
            Fit(moved.model.with_compliance(found[:n], found[n:]), moved.frame, NONE),
            kept,
            linear,
        )


def _spread(linear: Linear, kept: Mask) -> Array:
    """Return 1 sigma of the kept flexibilities, rad/Nm."""
    A = linear.matrix[:, kept]
    return np.sqrt(np.diag(np.linalg.pinv(A.T @ A, hermitian=True)))


@dataclass(frozen=True)
class _Found:
    """The fit of all rows, and what it was made of."""

    fit: Fit
    noise: Array  # (2,) m, rad
    base: Fit  # one step before
    rows: Pass  # at its shape
    shown: base_parameters.Identifiable
    geometry: Geometry | None = None  # in the models of both fits

    def scattered(self, rows: Data, sigma: float) -> base_parameters.Identifiable:
        """Return what is shown, as surely as some rows say by poses left out."""
        return by_poses(replace(self.fit, geometry=self.geometry), rows, self.shown, sigma)

    def written(self, fit: Fit, rows: Data) -> Fit:
        """Return a fit as a cell has it, its frame and tool point fitted to some rows."""
        return as_written(replace(fit, geometry=self.geometry), rows)


def identify_streamed(
    model: Model,
    log: Iterable[Log],
    metrology: Metrology | None = None,
    progress: Callable[[str], None] | None = None,
) -> Identification:
    """Return what ``identify_compliance`` does, for a log that comes in pieces.

    ``log`` is iterated over once (core.log.pieces.LogPieces, or a list of logs). Raises as
    ``identify_compliance``.
    """
    metrology = metrology or Metrology()
    emit = progress or (lambda text: None)
    emit("reading")
    stream = _stream(log, metrology, model)
    prior = prior_of(model)
    require_excitation(model, stream.sample, metrology, prior[1])
    task = _Task(prior)
    emit("fitting")
    before = replace(fit_nuisances(model, stream.sample), weights=NONE)
    beside = _beside_geometry(before, stream.sample, task)
    begin = replace(before if beside is None else beside.fit, geometry=None)
    found = task.run(task.near(begin, stream.sample), stream)
    if beside is not None:
        found = replace(
            found, geometry=beside.fit.geometry, shown=beside.widened(found.shown, prior[1])
        )
    emit("checking on held-out rows")
    held_out = _held_out(stream, task, before, found)
    held = beside is not None and held_out[1] > held_out[0]
    if held:  # the cell would be worse without the links found
        found = task.run(task.near(before, stream.sample), stream)
        held_out = _held_out(stream, task, before, found)
    found = replace(found, shown=found.scattered(stream.sample, prior[1]))
    return _result(model, stream, before, found, held_out, held)


@dataclass(frozen=True)
class _BesideGeometry:
    """A fit to some rows with the geometry in it, and its problem with that free, and held."""

    fit: Fit
    free: Linear
    held: Linear

    def widened(
        self, shown: base_parameters.Identifiable, sigma: float
    ) -> base_parameters.Identifiable:
        """Return what all rows show at this geometry, with what it leaves open."""
        wide, narrow = (
            base_parameters.what_is_shown(own, shown.kept, sigma).covariance
            for own in (self.free, self.held)
        )
        return replace(shown, covariance=shown.covariance + wide - narrow)


def _beside_geometry(before: Fit, sample: Data, task: _Task) -> _BesideGeometry | None:
    """Return the fit with the geometry that some rows show, None if they show none.

    All rows are then fitted with it as it is.
    """
    some = sample.part(slice(None, None, max(len(sample.q) // LINK_ROWS, 1)))
    fit = with_free_geometry(task.near(before, some), some)
    if fit.geometry is None:
        return None
    fit = task.near(fit, some)
    free, held = (projected(fit, some, own) for own in (fit.geometry, None))
    return _BesideGeometry(replace(fit, weights=NONE), free, held)


def _stream(log: Iterable[Log], metrology: Metrology, model: Model) -> Stream:
    """Return the rows with measured poses; passes once over the log."""
    store, first, empty = RowStore(), 0, None
    motions, timed = by_approach(model.terms), at_moment(model.terms)
    for part in log:
        data, used = data_of(part, metrology, motions)
        if not timed:  # nothing asks for it, and it is as long as the log
            data = replace(data, loads=replace(data.loads, time=None))
        if len(used):
            store.append(data, used + first)
        else:
            empty = data
        first += len(part)
    every = max(store.count // SAMPLE, 1)
    kept, folds = [], []
    for number, (data, rows) in enumerate(store):
        fold = np.empty(len(rows), dtype=np.int64)
        for k, stretch in stretches(number, len(rows)):
            fold[stretch] = k
        taken = rows % every == 0
        kept.append(data.part(taken))
        folds.append(fold[taken])
    if not kept:  # no row at all: the usual way says so
        assert empty is not None
        kept, folds = [empty], [np.zeros(0, dtype=np.int64)]
    sample = _joined(kept)
    width = 3 if sample.rotation is None else 6

    def pieces() -> Iterator[Piece]:
        for number, (data, rows) in enumerate(store):
            yield Piece(data, rows, tuple(stretches(number, len(rows))))

    fold = np.concatenate(folds)
    return Stream(pieces, sample, fold, store.count, width, sample.nuisances)


def _joined(parts: list[Data]) -> Data:
    def stacked(values: list[Array | None]) -> Array | None:
        given = [value for value in values if value is not None]
        return np.concatenate(given) if given else None

    loads = Loads(
        *(
            stacked([getattr(part.loads, name) for part in parts])
            for name in ("payload_mass", "payload_cog", "wrench", "temperature", "approach", "time")
        )
    )
    return Data(
        np.concatenate([part.q for part in parts]),
        loads,
        np.concatenate([part.position for part in parts]),
        stacked([part.rotation for part in parts]),
        parts[0].registered,
    )


def _held_out(stream: Stream, task: _Task, before: Fit, found: _Found) -> tuple[float, float]:
    """Return the rms before and after over the sample's inliers that each fit did not see.

    Fits without a fold are one step from the fit to all rows, whose shape and weights they share.
    """
    sums, cells, nuisances = np.zeros(2), 0, stream.nuisances
    gap = residual(found.fit.model, stream.sample, found.fit.frame)[0]
    inlier = weights_at(gap, found.noise) > 0
    placing = passed(before, scale_of(before, stream.sample), stream.of_sample()).factors
    for k in range(FOLDS):
        unseen = (stream.fold == k) & inlier
        if not (stream.fold != k).any() or not unseen.any():
            continue
        R = joined(np.delete(placing, k, axis=0))
        others = joined(np.delete(found.rows.factors, k, axis=0))
        fits = (
            placed(before, R[:, -1], R[:, :nuisances]),
            found.written(
                task.step(found.base, others, nuisances)[0], stream.sample.part(stream.fold != k)
            ),
        )
        judged = stream.sample.part(unseen)
        gaps = [residual(fit.model, judged, fit.frame)[0][:, :3] for fit in fits]
        sums += [float(np.sum(gap**2)) for gap in gaps]
        cells += gaps[0].size
    before_rms, after_rms = np.sqrt(sums / max(cells, 1))
    return float(before_rms), float(after_rms)


def _result(
    model: Model, stream: Stream, before: Fit, found: _Found, held_out: tuple[float, float],
    held: bool,
) -> Identification:  # fmt: skip
    n, shown, after = model.arm.n, found.shown, found.written(found.fit, stream.sample)
    kept = shown.kept
    # the last step is too small to be seen in what is left before it
    square, left, inlier_rows, outliers = 0.0, 0.0, 0, list[Rows]()
    for piece, inlier in zip(stream.pieces(), found.rows.inlier, strict=True):
        gap = residual(before.model, piece.data, before.frame)[0]
        square += float(np.sum(gap[inlier, :3] ** 2))
        if found.geometry is not None:
            gap = residual(after.model, piece.data, after.frame)[0]
            left += float(np.sum(gap[inlier, :3] ** 2))
        inlier_rows += int(inlier.sum())
        outliers.append(piece.rows[~inlier])
    spent = np.array([stream.nuisances, stream.nuisances + int(kept.sum())])
    sums = np.array([square, found.rows.square if found.geometry is None else left])
    gap_rms, remaining_rms = np.sqrt(sums / np.maximum(3 * inlier_rows - spent, 1))
    std, flexibility = np.sqrt(np.diag(shown.covariance)), after.flexibility
    count, known = stream.count - inlier_rows, tool_known(after, stream.sample, model)
    named = np.fromiter(islice((row for rows in outliers for row in rows), MANY_OUTLIERS), np.int64)
    return Identification(
        after.model, flexibility[:n], flexibility[n:], std[:n], std[n:], shown.covariance, kept,
        shown.reported, after.frame,
        after.model.tool_in_flange[:3, 3] - model.tool_in_flange[:3, 3], stream.count,
        float(gap_rms), float(remaining_rms), *held_out, named,
        tuple(notes_of(after, kept, count, stream.nuisances, known, found.geometry, held)),
        tool_known=known,
    )  # fmt: skip
