"""Identification from logs of any length: read once, then processed in blocks of rows.

The same least squares, weights and choice of parameters as identification.py, started at the fit to
a sample of the rows. Held-out figures leave out every fifth block of rows, not whole poses, and are
evaluated on the sample.
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
    ProjectedSystem,
    as_cell_model,
    fit_flexibilities,
    fit_nuisances,
    gauss_newton_step,
    projected,
    residual,
    solve,
    with_free_geometry,
)
from gapbridge.core.estimation.flexibilities import prior_of
from gapbridge.core.estimation.geometry import Geometry
from gapbridge.core.estimation.held_out import FOLDS
from gapbridge.core.estimation.identification import (
    Identification,
    data_of,
    notes_of,
    require_excitation,
    tool_determined,
)
from gapbridge.core.estimation.pose_scatter import with_pose_scatter
from gapbridge.core.estimation.robust import weights_at
from gapbridge.core.estimation.sampling import one_of_each_stretch
from gapbridge.core.estimation.streamed_fit import (
    NO_WEIGHTS,
    Accumulated,
    Piece,
    Stream,
    accumulate,
    fold_slices,
    merged_factor,
    scale_of,
    with_nuisance_step,
)
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

MEMORY_LIMIT = 128 << 20  # bytes in memory
Rows = NDArray[np.int64]
SAMPLE_ROWS = 20_000  # of the sample, for the start and the check of the excitation
MAX_OUTLIERS = 100_000  # listed rows at most
STEP_CONVERGED = 0.2  # step over sigma, with many rows
LINK_ROWS = 2000  # rows of the sample that determine the links
SAMPLE_CONVERGED = 1e-3  # relative step on the sample


class RowStore:
    """Blocks of rows with measured poses and their row numbers; a temporary file beyond a limit."""

    def __init__(self, memory: int = MEMORY_LIMIT) -> None:
        self.count = 0
        self._free = memory
        self._blocks: list[tuple[Data, NDArray[np.int64]]] = []
        self._file: Any = None

    def append(self, data: Data, rows: NDArray[np.int64]) -> None:
        """Store a block; ``rows`` (k,) are the numbers of its rows, from 0."""
        columns = {f.name: getattr(data.loads, f.name) for f in fields(Loads)}
        loads = Loads(**{k: None if v is None else self._stored(v) for k, v in columns.items()})
        self._blocks.append((
            replace(
                data, q=self._stored(data.q), position=self._stored(data.position), loads=loads,
                rotation=None if data.rotation is None else self._stored(data.rotation),
            ),
            self._stored(rows),
        ))  # fmt: skip
        self.count += len(rows)

    def __iter__(self) -> Iterator[tuple[Data, NDArray[np.int64]]]:
        """Yield the blocks in the order in which they came."""
        return iter(self._blocks)

    def _stored(self, values: NDArray[Any]) -> NDArray[Any]:
        if len(values) and (values == values[0]).all():  # constant, such as a payload's cog
            return np.broadcast_to(values[:1].copy(), values.shape)
        if values.nbytes <= self._free:
            self._free -= values.nbytes
            return values
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="gapbridge-")  # noqa: SIM115 - lives as long
        offset = self._file.seek(0, 2)
        self._file.write(np.ascontiguousarray(values).tobytes())
        self._file.flush()
        return np.memmap(self._file, values.dtype, "r", offset, values.shape)


@dataclass(frozen=True)
class _Fitting:
    """The steps of a fit to a stream, with the prior of the flexibilities."""

    prior: tuple[Array, float]

    def fit_sample(self, before: Fit, rows: Data) -> Fit:
        """Fit all flexibilities to the sample, as the start of the fit to all rows."""
        everything = np.ones(len(self.prior[0]), dtype=bool)
        return fit_flexibilities(before, rows, everything, self.prior, converged=SAMPLE_CONVERGED)

    def run(self, begin: Fit, stream: Stream) -> _StreamedFit:
        """Choose the identifiable flexibilities by all rows, and fit them.

        With many rows it ends at a step well below the standard deviations.
        """
        now, long = begin, stream.count > SAMPLE_ROWS
        kept: Mask | None = None
        for _ in range(ROUNDS):
            noise = scale_of(now, stream.sample)
            rows = accumulate(now, noise, stream)
            R = merged_factor(rows.factors)
            spare = rows.equations - stream.nuisances
            result, kept, linear = self.step(now, R, stream.nuisances, spare, kept)
            change = np.abs(result.flexibility - now.flexibility)
            base, now = now, result
            if change.max() < CONVERGED * max(np.abs(now.flexibility).max(), 1e-12):
                break
            if long and (change[kept] < STEP_CONVERGED * _spread(linear, kept)).all():
                break
        assert kept is not None
        left = base_parameters.residual_noise(
            linear, now.flexibility, kept, self.prior[1], spare
        )  # fmt: skip
        shown = base_parameters.identifiability_of(linear, kept, self.prior[1], left)
        return _StreamedFit(now, noise, base, rows, shown)

    def step(
        self, state: Fit, R: Array, nuisances: int, spare: float, kept: Mask | None = None
    ) -> tuple[Fit, Mask, ProjectedSystem]:
        """Return the fit after one step, the kept flexibilities and the projected system.

        ``R`` is the factor of the fitted rows, linearised at ``state``; ``kept`` None: chosen here,
        by the noise of the residual for ``spare`` equations more than nuisances.
        """
        F, A, b = R[:, :nuisances], R[:, nuisances:-1], R[:, -1]
        centre, n = self.prior[0], state.model.arm.n
        all_free = np.ones(len(centre), dtype=bool)
        first = gauss_newton_step(state, (F, A, b), NO_WEIGHTS, all_free, self.prior)
        linear = first.linear
        assert linear is not None
        if kept is None:
            noise = base_parameters.residual_noise(
                linear, first.flexibility, all_free, self.prior[1], spare
            )
            kept = base_parameters.choose_identifiable(linear, self.prior, noise)
        begin = np.where(kept, state.flexibility, centre)
        solution = solve(linear, kept, begin, self.prior)
        placed = with_nuisance_step(state, b - A @ (solution - state.flexibility), F)
        model = placed.model.with_compliance(solution[:n], solution[n:])
        return Fit(model, placed.frame, NO_WEIGHTS), kept, linear


def _spread(linear: ProjectedSystem, kept: Mask) -> Array:
    """Return 1 sigma of the kept flexibilities, rad/Nm."""
    A = linear.matrix[:, kept]
    return np.sqrt(np.diag(np.linalg.pinv(A.T @ A, hermitian=True)))


@dataclass(frozen=True)
class _StreamedFit:
    """The fit of all rows, with the sums of its last step."""

    fit: Fit
    noise: Array  # (2,) m, rad
    base: Fit  # one step before
    rows: Accumulated  # linearised at ``base``
    shown: base_parameters.Identifiable
    geometry: Geometry | None = None  # in the models of both fits

    def with_pose_scatter(self, rows: Data, sigma: float) -> base_parameters.Identifiable:
        """Return the identifiability, with the covariance by poses left out."""
        return with_pose_scatter(replace(self.fit, geometry=self.geometry), rows, self.shown, sigma)

    def written(self, fit: Fit, rows: Data) -> Fit:
        """Return a fit as a cell stores it, its frame and tool point fitted to some rows."""
        return as_cell_model(replace(fit, geometry=self.geometry), rows)


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
    fitting = _Fitting(prior)
    emit("fitting")
    before = replace(fit_nuisances(model, stream.sample), weights=NO_WEIGHTS)
    with_links = _fit_with_geometry(before, stream.sample, fitting)
    begin = replace(before if with_links is None else with_links.fit, geometry=None)
    result = fitting.run(fitting.fit_sample(begin, stream.sample), stream)
    if with_links is not None:
        shown = with_links.with_geometry_covariance(result.shown, prior[1])
        result = replace(result, geometry=with_links.fit.geometry, shown=shown)
    emit("checking on held-out rows")
    held_out = _held_out(stream, fitting, before, result)
    links_held = with_links is not None and held_out[1] > held_out[0]
    if links_held:  # without the estimated links the cell would predict worse
        result = fitting.run(fitting.fit_sample(before, stream.sample), stream)
        held_out = _held_out(stream, fitting, before, result)
    result = replace(result, shown=result.with_pose_scatter(stream.sample, prior[1]))
    return _result(model, stream, before, result, held_out, links_held)


@dataclass(frozen=True)
class _GeometryFit:
    """A fit to some rows with geometry, and its projected system with geometry free, and fixed."""

    fit: Fit
    free: ProjectedSystem
    fixed: ProjectedSystem

    def with_geometry_covariance(
        self, shown: base_parameters.Identifiable, sigma: float
    ) -> base_parameters.Identifiable:
        """Return the identifiability by all rows, plus the covariance due to the geometry."""
        wide, narrow = (
            base_parameters.identifiability_of(system, shown.kept, sigma, shown.noise).covariance
            for system in (self.free, self.fixed)
        )
        return replace(shown, covariance=shown.covariance + wide - narrow)


def _fit_with_geometry(before: Fit, sample: Data, fitting: _Fitting) -> _GeometryFit | None:
    """Return the fit of some rows with geometry, which is then fixed; None: likelier without."""
    sample_rows = sample.part(one_of_each_stretch(len(sample.q), LINK_ROWS))
    fit = with_free_geometry(fitting.fit_sample(before, sample_rows), sample_rows)
    if fit.geometry is None:
        return None
    fit = fitting.fit_sample(fit, sample_rows)
    free, fixed = (projected(fit, sample_rows, own) for own in (fit.geometry, None))
    return _GeometryFit(replace(fit, weights=NO_WEIGHTS), free, fixed)


def _stream(log: Iterable[Log], metrology: Metrology, model: Model) -> Stream:
    """Return the rows with measured poses; passes once over the log."""
    store, first, empty = RowStore(), 0, None
    motions, timed = by_approach(model.terms), at_moment(model.terms)
    for part in log:
        data, used = data_of(part, metrology, motions)
        if not timed:  # not needed, and as long as the log
            data = replace(data, loads=replace(data.loads, time=None))
        if len(used):
            store.append(data, used + first)
        else:
            empty = data
        first += len(part)
    taken, begin = one_of_each_stretch(store.count, SAMPLE_ROWS), 0
    kept, folds = [], []
    for number, (data, rows) in enumerate(store):
        fold = np.empty(len(rows), dtype=np.int64)
        for k, rows_of_fold in fold_slices(number, len(rows)):
            fold[rows_of_fold] = k
        end = begin + len(rows)
        sampled = taken[(taken >= begin) & (taken < end)] - begin
        begin = end
        kept.append(data.part(sampled))
        folds.append(fold[sampled])
    if not kept:  # no row at all: reported by require_excitation
        assert empty is not None
        kept, folds = [empty], [np.zeros(0, dtype=np.int64)]
    sample = _concatenated(kept)
    width = 3 if sample.rotation is None else 6

    def pieces() -> Iterator[Piece]:
        for number, (data, rows) in enumerate(store):
            yield Piece(data, rows, tuple(fold_slices(number, len(rows))))

    fold = np.concatenate(folds)
    return Stream(pieces, sample, fold, store.count, width, sample.nuisances)


def _concatenated(parts: list[Data]) -> Data:
    def joined(values: list[Array | None]) -> Array | None:
        parts_given = [value for value in values if value is not None]
        return np.concatenate(parts_given) if parts_given else None

    loads = Loads(
        *(
            joined([getattr(part.loads, name) for part in parts])
            for name in ("payload_mass", "payload_cog", "wrench", "temperature", "approach", "time")
        )
    )
    return Data(
        np.concatenate([part.q for part in parts]),
        loads,
        np.concatenate([part.position for part in parts]),
        joined([part.rotation for part in parts]),
        parts[0].registered,
    )


def _held_out(
    stream: Stream, fitting: _Fitting, before: Fit, result: _StreamedFit
) -> tuple[float, float]:
    """Return the rms before and after over the sample's inliers that each fit did not see.

    Fits without a fold are one step from the fit to all rows, whose shape and weights they share.
    """
    sums, cells, nuisances = np.zeros(2), 0, stream.nuisances
    spare = result.rows.equations * (1 - 1 / FOLDS) - nuisances
    gap = residual(result.fit.model, stream.sample, result.fit.frame)[0]
    inlier = weights_at(gap, result.noise) > 0
    factors = accumulate(before, scale_of(before, stream.sample), stream.sample_only()).factors
    for k in range(FOLDS):
        unseen = (stream.fold == k) & inlier
        if not (stream.fold != k).any() or not unseen.any():
            continue
        R = merged_factor(np.delete(factors, k, axis=0))
        remaining = merged_factor(np.delete(result.rows.factors, k, axis=0))
        fits = (
            with_nuisance_step(before, R[:, -1], R[:, :nuisances]),
            result.written(
                fitting.step(result.base, remaining, nuisances, spare)[0],
                stream.sample.part(stream.fold != k),
            ),
        )
        judged = stream.sample.part(unseen)
        gaps = [residual(fit.model, judged, fit.frame)[0][:, :3] for fit in fits]
        sums += [float(np.sum(gap**2)) for gap in gaps]
        cells += gaps[0].size
    before_rms, after_rms = np.sqrt(sums / max(cells, 1))
    return float(before_rms), float(after_rms)


def _result(
    model: Model, stream: Stream, before: Fit, result: _StreamedFit, held_out: tuple[float, float],
    links_held: bool,
) -> Identification:  # fmt: skip
    n, shown, after = model.arm.n, result.shown, result.written(result.fit, stream.sample)
    kept = shown.kept
    # the residual one step before differs negligibly
    square, left, inlier_rows, outliers = 0.0, 0.0, 0, list[Rows]()
    for piece, inlier in zip(stream.pieces(), result.rows.inlier, strict=True):
        gap = residual(before.model, piece.data, before.frame)[0]
        square += float(np.sum(gap[inlier, :3] ** 2))
        if result.geometry is not None:
            gap = residual(after.model, piece.data, after.frame)[0]
            left += float(np.sum(gap[inlier, :3] ** 2))
        inlier_rows += int(inlier.sum())
        outliers.append(piece.rows[~inlier])
    spent = np.array([stream.nuisances, stream.nuisances + int(kept.sum())])
    sums = np.array([square, result.rows.square if result.geometry is None else left])
    gap_rms, remaining_rms = np.sqrt(sums / np.maximum(3 * inlier_rows - spent, 1))
    std, flexibility = np.sqrt(np.diag(shown.covariance)), after.flexibility
    count, known = stream.count - inlier_rows, tool_determined(after, stream.sample, model)
    named = np.fromiter(islice((row for rows in outliers for row in rows), MAX_OUTLIERS), np.int64)
    return Identification(
        after.model, flexibility[:n], flexibility[n:], std[:n], std[n:], shown.covariance, kept,
        shown.notes, after.frame,
        after.model.tool_in_flange[:3, 3] - model.tool_in_flange[:3, 3], stream.count,
        float(gap_rms), float(remaining_rms), *held_out, named,
        tuple(notes_of(after, kept, count, stream.nuisances, known, result.geometry, links_held)),
        tool_determined=known,
    )  # fmt: skip
