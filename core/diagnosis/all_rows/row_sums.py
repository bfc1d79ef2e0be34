"""Validation on all rows of a long recording, block by block, by sums of products.

A fit and its validation need only the sums of products of the rows' columns, by coordinate and
block of time. These give as many rows as there are columns with the same sums: the sample space of
all rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.all_rows.long_recording import Block, LongRecording
from gapbridge.core.diagnosis.channels.recording import STRETCHES
from gapbridge.core.diagnosis.criteria import MAX_OUTLIER_SHARE, PRIOR_REACH
from gapbridge.core.diagnosis.noise_floor import BLOCK, counted_coordinates, own_coordinates
from gapbridge.core.diagnosis.observation import NotObservable, Observation
from gapbridge.core.diagnosis.selection.candidate import Candidate, jacobian, named_columns
from gapbridge.core.diagnosis.selection.delay_columns import chord_columns, chord_value
from gapbridge.core.diagnosis.selection.noise import Noise
from gapbridge.core.diagnosis.selection.refit import LinearisedTerms, with_free_shape
from gapbridge.core.diagnosis.selection.sample_space import SampleSpace, fit, penalties
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.diagnosis.selection.state import UnprojectedRows, candidate_of, chords_only
from gapbridge.core.effects import Term
from gapbridge.core.estimation.robust import OUTLIER, distance_of, scale_of
from gapbridge.core.log.log import Log

Observe = Callable[[Log], Observation | NotObservable]


@dataclass(frozen=True)
class Gap:
    """The gap over all inliers, per coordinate of the channel."""

    samples: int  # outliers included
    squares: Array  # (k,) sum of squares, nominal model
    largest: float  # vector norm of what counts in the rms
    outliers: Index  # rows of the log

    @property
    def kept(self) -> int:
        """Return the number of inliers."""
        return self.samples - len(self.outliers)


class Columns:
    """The columns of a block: candidates' columns, target, the terms' Jacobian, gap."""

    def __init__(self, selection: Selection, accused: Sequence[int], arm: Arm) -> None:
        self.candidates = selection.space.candidates
        self.accused = tuple(accused)
        self.terms = tuple(selection.terms[p] for p in accused)
        self.freed = [with_free_shape(arm, self.candidates[p]) for p in accused]
        self.x = [
            np.array(term.values)[: len(c.parameters)]
            for term, c in zip(self.terms, self.freed, strict=True)
        ]
        observation = selection.observation
        self._chords = [
            chord_value(observation, c, self.terms)
            if observation.channel == "tracking" and len(c.parameters) == 1 else None
            for c in self.candidates
        ]  # fmt: skip
        self._from_nothing = chords_only(observation, self.terms)
        self.start = selection.space.start
        self.jacobian = int(self.start[-1]) + 1 + np.arange(sum(len(x) for x in self.x))

    @property
    def width(self) -> int:
        """Return how many columns there are."""
        return int(self.start[-1]) + 2 + len(self.jacobian)

    def at_samples(self, observation: Observation, nominal_gap: Array, gap: Array) -> Array:
        """Return the columns (N, k, width) of an observation; ``nominal_gap`` has no terms."""
        columns = [
            self._candidate(observation, c, chord)
            for c, chord in zip(self.candidates, self._chords, strict=True)
        ]
        target = nominal_gap
        if not self._from_nothing:  # the terms' linear part is added back
            target = gap
            for term in self.terms:
                c, x = candidate_of(list(self.candidates), term)
                target = target + columns[c] @ x
        blocks = [
            jacobian(observation, c, x, self.terms[:i] + self.terms[i + 1 :])
            for i, (c, x) in enumerate(zip(self.freed, self.x, strict=True))
        ]
        return np.concatenate([*columns, target[..., None], *blocks, gap[..., None]], axis=2)

    def _candidate(self, observation: Observation, c: Candidate, chord: float | None) -> Array:
        if chord is not None:
            return chord_columns(observation, c, self.terms, chord)
        base = () if observation.channel == "tracking" else self.terms
        return named_columns(observation, c, base)


@dataclass(frozen=True)
class Streamed:
    """The sums of products over all rows of a recording, linearised at the accused terms."""

    excerpt: Selection
    columns: Columns
    sums: Array  # (B, k, width, width) of each block and coordinate, whitened
    time: Array  # (B,) s, of each block
    session: Index  # (B,)
    row: Index  # (B,) first row of each block in the log
    gap: Gap
    means: Array  # (bins, k, p + 1): Jacobian and gap over every BLOCK seconds, whitened
    inverse_sigma: Array  # (k,) one over 1 sigma of each coordinate
    by_region: bool  # covariances include the scatter among regions

    def selection(self, accused: Sequence[int]) -> Selection:
        """Return the selection of some of the terms only, fitted on all rows."""
        terms, covariance = list(self.excerpt.terms), list(self.excerpt.covariance)
        values, spread = self._fitted(accused)
        freed = dict(zip(self.columns.accused, self.columns.freed, strict=True))
        for p, value, term_covariance in zip(accused, values, spread, strict=True):
            terms[p], covariance[p] = freed[p].term(value), term_covariance
        space, unprojected = self._space()
        observation, noise = self._samples()
        return Selection(
            observation, space, fit(space, tuple(accused)), tuple(terms),
            tuple(range(len(terms))), tuple(covariance),
            np.ones(len(observation.rows), dtype=bool), noise, observation.measured,
            self.columns.terms, unprojected, rows_each=self.gap.kept / len(observation.rows),
            excerpt=self.excerpt,
        )  # fmt: skip

    def alone(self, _: Selection, accused: Sequence[int]) -> Selection:
        """Return the selection of some of the terms; another selection's space is the same."""
        return self.selection(accused)

    def linearised(self, selection: Selection, accused: Sequence[int]) -> None:
        """Return None: ``alone`` is fast, and of first order itself."""

    def remaining(self, selection: Selection, accused: Sequence[int]) -> tuple[Array, Array]:
        """Return the residual's squares (k,) summed over rows, and means (bins, k) over time."""
        selector = self._selector(accused)
        freed = dict(zip(self.columns.accused, self.columns.freed, strict=True))
        x = dict(zip(self.columns.accused, self.columns.x, strict=True))
        changes = [
            np.array(selection.terms[p].values)[: len(freed[p].parameters)] - x[p] for p in accused
        ]
        combination = selector @ np.concatenate([*(-m for m in changes), [1.0]])
        used = [*self.columns.jacobian, self.columns.width - 1]
        sums = self.sums.sum(axis=0)[:, used][:, :, used]
        squares = np.einsum("i,kij,j->k", combination, sums, combination) / self.inverse_sigma**2
        in_unit = own_coordinates(self.excerpt.observation)
        return np.maximum(squares, 0.0), (self.means @ combination / self.inverse_sigma)[
            :, :in_unit
        ]

    def _selector(self, accused: Sequence[int]) -> Array:
        """Return the matrix (p + 1, d + 1) to Jacobian and gap of some terms, others added back."""
        size = len(self.columns.jacobian) + 1
        kept, gap, start = [], np.zeros(size), 0
        gap[-1] = 1.0
        for p, x in zip(self.columns.accused, self.columns.x, strict=True):
            if p in accused:
                kept.append((p, np.eye(size)[:, start : start + len(x)]))
            else:
                gap[start : start + len(x)] = x
            start += len(x)
        order = dict(kept)
        return np.hstack([*(order[p] for p in accused), gap[:, None]])

    @property
    def _stretch(self) -> Index:
        """Return the stretch of time (B,) of each block, pauses left out: blocks are even."""
        return np.arange(len(self.sums)) * STRETCHES // len(self.sums)

    def _fitted(self, accused: Sequence[int]) -> tuple[list[Array], list[Array]]:
        if not accused:
            return [], []
        used = [*self.columns.jacobian, self.columns.width - 1]
        part = self._stretch if self.by_region else np.zeros(len(self.sums), dtype=np.int64)
        names = np.unique(part)
        sums = np.stack([self.sums[part == name].sum(axis=(0, 1)) for name in names])
        rows = rows_of(sums[:, used][:, :, used])
        flat = rows.reshape(-1, rows.shape[2])
        terms = LinearisedTerms(
            self.columns.freed, self.columns.x,
            [PRIOR_REACH * c.scales for c in self.columns.freed], flat[:, :-1], flat[:, -1],
            np.repeat(names, rows.shape[1]) if self.by_region else None,
            float(self.gap.kept * len(self.inverse_sigma)), self.excerpt.space.floor,
        )  # fmt: skip
        return terms.alone([self.columns.accused.index(p) for p in accused])

    def _space(self) -> tuple[SampleSpace, UnprojectedRows]:
        """Return the sample space of all rows, as rows with the same sums."""
        target = int(self.columns.start[-1])
        rows = rows_of(self.sums[:, :, : target + 1, : target + 1])
        flat = rows.transpose(0, 2, 1, 3).reshape(-1, target + 1)  # coordinates side by side
        X, y = np.ascontiguousarray(flat[:, :target]), flat[:, target]
        space, freedom = self.excerpt.space, float(self.gap.kept * len(self.inverse_sigma))
        extra = space.penalty - penalties(space.candidates, space.freedom)
        nothing = np.zeros((len(y), 0))
        return (
            replace(
                space, y=y, X=X, freedom=freedom,
                penalty=penalties(space.candidates, freedom) + extra,
            ),
            UnprojectedRows(nothing, y, nothing, np.zeros((0, target))),
        )  # fmt: skip

    def _samples(self) -> tuple[Observation, Noise]:
        """Return the samples that represent the rows, the same number for each block."""
        each, k = int(self.columns.start[-1]) + 1, len(self.inverse_sigma)
        samples = each * len(self.time)
        whole = self.excerpt.observation
        observation = replace(
            whole,
            measured=np.zeros((samples, k)),
            nuisance=np.zeros((samples, k, 0)),
            quantities={"timestamp": np.repeat(self.time, each)},
            groups=np.repeat(self._stretch, each),
            rows=np.repeat(self.row, each),
            session=None if whole.session is None else np.repeat(self.session, each),
            joint_columns=None, friction=None, times=None, payload_mass=None, subset=None,
            unnamed=tuple,
        )  # fmt: skip
        whitener = np.broadcast_to(np.diag(self.inverse_sigma), (samples, k, k))
        return observation, replace(self.excerpt.noise, whitener=whitener)


def rows_of(sums: Array) -> Array:
    """Return rows R (..., p, p) with given sums of products R^T R (..., p, p)."""
    size = np.sqrt(np.maximum(np.einsum("...ii->...i", sums), 0.0))
    unit = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
    value, V = np.linalg.eigh(sums * unit[..., :, None] * unit[..., None, :])
    root = np.sqrt(np.maximum(value, 0.0))[..., :, None]
    return np.asarray(root * np.swapaxes(V, -1, -2) * size[..., None, :])


class RowSums:
    """The sums over all rows of a recording, at the accused terms of its excerpt, block by block.

    ``observe`` returns the channel in a block; ``by_region``: covariances by scatter among regions.
    """

    def __init__(
        self, selection: Selection, accused: Sequence[int], observe: Observe, arm: Arm,
        by_region: bool,
    ) -> None:  # fmt: skip
        self._selection, self._observe, self._by_region = selection, observe, by_region
        self._columns = Columns(selection, accused, arm)
        self._inverse_sigma = np.asarray(np.diag(selection.noise.whitener[0]))
        self._limit = _limit(selection, self._columns.terms, self._inverse_sigma)
        counted = counted_coordinates(selection.observation)
        self._weight = selection.observation.weight[:counted]
        self._blocks: list[tuple[Array, float, int, int]] = []
        self._outliers: list[Index] = []
        self._means = _BlockMeans(self._columns)
        self._samples, self._squares, self._largest = 0, np.zeros(len(self._inverse_sigma)), 0.0

    def add(self, recording: LongRecording, block: Block) -> None:
        """Add the rows of a block."""
        observation = self._observe(block.log)
        if isinstance(observation, NotObservable):
            return
        inside = observation.rows + block.first >= block.begin
        rows = observation.rows[inside] + block.first
        if not len(rows):
            return
        nominal_gap = observation.measured - observation.predict(())
        terms = self._columns.terms
        gap = observation.measured - observation.predict(terms) if terms else nominal_gap
        columns = self._columns.at_samples(observation, nominal_gap, gap)
        whole = columns[inside] * self._inverse_sigma[:, None]
        kept = np.sqrt(np.mean(whole[:, :, -1] ** 2, axis=1)) <= self._limit
        whole, nominal_gap = whole[kept], nominal_gap[inside][kept]
        self._samples += len(rows)
        self._outliers.append(rows[~kept])
        if not len(nominal_gap):
            return
        self._squares += np.einsum("ij,ij->j", nominal_gap, nominal_gap)
        weighted = nominal_gap[:, : len(self._weight)] * self._weight
        farthest = float(np.linalg.norm(weighted, axis=1).max())
        self._largest = max(self._largest, farthest)
        time = recording.log.columns["timestamp"][rows[kept]]
        self._means.add(time, whole)
        by_coordinate = np.ascontiguousarray(whole.transpose(1, 0, 2))
        sums = by_coordinate.transpose(0, 2, 1) @ by_coordinate
        self._blocks.append(
            (sums, float(time.mean()), _session(recording, block), int(rows[0]))
        )  # fmt: skip

    def streamed(self) -> Streamed:
        """Return the sums over all blocks."""
        sums, time, session, first = zip(*self._blocks, strict=True)
        gap = Gap(self._samples, self._squares, self._largest, np.concatenate(self._outliers))
        return Streamed(
            self._selection, self._columns, np.stack(sums), np.array(time), np.array(session),
            np.array(first), gap, self._means.whole(), self._inverse_sigma, self._by_region,
        )  # fmt: skip


def _session(recording: LongRecording, block: Block) -> int:
    named = bool(recording.log.session_names)
    return int(recording.log.columns["session"][block.begin]) if named else 0


def _limit(selection: Selection, terms: Sequence[Term], inverse_sigma: Array) -> float:
    """Return the whitened distance from which a row is an outlier, at most a share of all."""
    observation = selection.observation
    residual = (observation.measured - observation.predict(terms)) * inverse_sigma
    high = float(np.quantile(distance_of(residual, 1.0), 1 - MAX_OUTLIER_SHARE))
    return max(OUTLIER * scale_of(residual), high)


class _BlockMeans:
    """Means of the Jacobian and the gap over every BLOCK seconds."""

    def __init__(self, columns: Columns) -> None:
        self._at = [*columns.jacobian, columns.width - 1]
        self._start: float | None = None
        self._parts: list[tuple[Index, Array, Array]] = []

    def add(self, time: Array, columns: Array) -> None:
        """Add rows in order of time (N,)."""
        if self._start is None:
            self._start = float(time[0])
        number = np.floor((time - self._start) / BLOCK).astype(np.int64)
        begins = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
        sums = np.add.reduceat(columns[:, :, self._at], begins, axis=0)
        self._parts.append((number[begins], sums, np.diff(begins, append=len(number))))

    def whole(self) -> Array:
        """Return the means (bins, k, p + 1)."""
        number, sums, count = (
            np.concatenate([part[i] for part in self._parts]) for i in range(3)
        )  # fmt: skip
        begins = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
        total = np.add.reduceat(sums, begins, axis=0)
        return np.asarray(total / np.add.reduceat(count, begins)[:, None, None])
