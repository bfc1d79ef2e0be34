"""The sample space in which candidates compete, the fit of a set in it, and the penalties."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import (
    ACCUSATION_PENALTY,
    MAX_TIMES_USUAL,
    OUT_OF_BOUNDS_SIGMAS,
    SMOOTH_PENALTY,
    TOO_LARGE_SIGMAS,
)
from gapbridge.core.diagnosis.selection.candidate import Candidate

RANK = 1e-10  # share of a column's square below which it is linearly dependent on the set
DEPENDENT = 1e-8  # the same of a candidate with several columns
AT_ONCE = 60_000  # numbers of a temporary: 0.5 MB
SENSOR_UNITS = ("N", "Nm", "N/s", "Nm/s")  # of sensor biases, which may have any size
USUAL_ORDERS = (1.0, 2.0, 3.0, 4.0)  # cycles per turn, of eccentricity and its harmonics


@dataclass(frozen=True)
class Blocks:
    """Candidates with equally many columns, with the Gram matrices of their unit columns."""

    index: NDArray[np.int64]  # (n,) candidates
    columns: NDArray[np.int64]  # (n, d)
    unit: Array  # (n, d) one over each column's size
    gram: Array  # (d, d, n) of the unit columns


def _blocks(X: Array, index: NDArray[np.int64], columns: NDArray[np.int64]) -> Blocks:
    n, d = columns.shape
    gram = np.empty((n, d, d))
    for few in np.array_split(np.arange(n), 1 + n * d * len(X) // AT_ONCE):
        block = X[:, columns[few].ravel()].T.reshape(len(few), d, len(X))
        gram[few] = block @ block.transpose(0, 2, 1)
    unit = 1 / np.sqrt(np.einsum("cii->ci", gram) + 1e-300)
    gram = gram * unit[:, :, None] * unit[:, None, :]
    return Blocks(index, columns, unit, np.ascontiguousarray(gram.transpose(1, 2, 0)))


@dataclass(frozen=True)
class SampleSpace:
    """The whitened sample space: y and the blocks of columns, nuisance projected out."""

    y: Array  # (m,)
    X: Array  # (m, K)
    start: NDArray[np.int64]  # (C+1,) first column of each candidate
    candidates: tuple[Candidate, ...]
    penalty: Array  # (C,)
    freedom: float  # m minus nuisance
    floor: float  # lower bound of the whitened variance

    @cached_property
    def blocks(self) -> tuple[Blocks, ...]:
        """Return the candidates grouped by their number of columns."""
        size = np.diff(self.start)
        return tuple(
            _blocks(self.X, index, self.start[index][:, None] + np.arange(d))
            for d in np.unique(size)
            for index in [np.flatnonzero(size == d)]
        )

    def columns(self, chosen: Sequence[int]) -> Array:
        """Return the columns of a set of candidates (m, sum d)."""
        parts = [self.X[:, self.start[c] : self.start[c + 1]] for c in chosen]
        return np.hstack(parts) if parts else np.zeros((len(self.y), 0))

    def column_indices(self, chosen: Sequence[int]) -> NDArray[np.int64]:
        """Return where in ``X`` the columns of a set of candidates are (sum d,)."""
        parts = [np.arange(self.start[c], self.start[c + 1]) for c in chosen]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)

    def misfit(self, rss: Array) -> Array:
        """Return -2 log likelihood of residual sums of squares, with the variance profiled out."""
        variance = np.maximum(rss / self.freedom, self.floor)
        return np.asarray(self.freedom * np.log(variance) + rss / variance)


@dataclass(frozen=True)
class CandidateFit:
    """One set of candidates with its joint least-squares fit."""

    chosen: tuple[int, ...]
    score: float
    rss: float
    values: tuple[Array, ...] = field(default=())  # per candidate (d,)
    deviations: tuple[Array, ...] = field(default=())  # per candidate (d,), 1 sigma


def penalties(candidates: Sequence[Candidate], freedom: float) -> Array:
    """Return the penalty of each candidate: d log m + 2 log(number of its kind) + a margin."""
    kinds = [_kind(c) for c in candidates]
    tried = dict.fromkeys(kinds, 0)
    for kind, c in zip(kinds, candidates, strict=True):
        tried[kind] += c.tried
    named = np.array([c.named for c in candidates], dtype=bool)
    families = len({c.family for c in candidates if c.named}) or 1
    alike = np.array([tried[kind] for kind in kinds]) * np.where(named, families, 1)
    d = np.array([len(c.parameters) for c in candidates])
    extra = np.where(named, ACCUSATION_PENALTY, SMOOTH_PENALTY)
    return np.asarray(d * np.log(max(freedom, 2.0)) + 2 * np.log(alike) + extra)


def _kind(candidate: Candidate) -> str:
    """Return the kind among which a candidate counts as one of many hypotheses."""
    if (candidate.site.order or 0) in USUAL_ORDERS and candidate.periodic:
        return "usual lines"
    if candidate.without_quantity:
        return "rivals"
    return candidate.family


def gains(space: SampleSpace, r: Array, along: Array | None = None) -> tuple[Array, Array]:
    """Return by how much each candidate reduces |r|^2 (C,), and the sign of its first value (C,).

    ``along`` (p, K) are the columns' components along an orthonormal basis that is projected out;
    ``r`` is orthogonal to it.
    """
    within = np.zeros((0, space.X.shape[1])) if along is None else along
    g = space.X.T @ r
    gain, sign = np.zeros(len(space.candidates)), np.ones(len(space.candidates))
    for blocks in space.blocks:
        products = (g[blocks.columns] * blocks.unit).T
        inside = within[:, blocks.columns] * blocks.unit
        d, n = products.shape
        whole = np.zeros((d + 1, d + 1, n))  # products of the columns and, last, of r
        np.subtract(blocks.gram, np.einsum("pci,pcj->ijc", inside, inside), out=whole[:d, :d])
        whole[d, :d] = whole[:d, d] = products
        gain[blocks.index] = -_eliminated(whole, RANK if d == 1 else DEPENDENT)
        if d == 1:
            sign[blocks.index] = np.sign(products[0])
    return gain, sign


def _eliminated(products: Array, least: float) -> Array:
    """Return the last diagonal element (n,) of n matrices (d, d, n) after Gaussian elimination.

    They are overwritten. A pivot of ``least`` or less counts as zero, and so does its column.
    """
    for k, row in enumerate(products[:-1]):
        inverse = 1 / np.where(row[k] > least, row[k], np.inf)
        products[k + 1 :, k + 1 :] -= (row[k + 1 :] * inverse)[:, None] * row[None, k + 1 :]
    return np.asarray(products[-1, -1])


def fit(space: SampleSpace, chosen: Sequence[int]) -> CandidateFit:
    """Return the joint fit of a set; its score is infinite where it is no explanation.

    That is where a value is not plausible, or as many are free as there are numbers to explain.
    """
    if not chosen:
        rss = float(space.y @ space.y)
        return CandidateFit((), float(space.misfit(np.array(rss))), rss)
    X = space.columns(chosen)
    unit = 1 / np.sqrt(np.einsum("ij,ij->j", X, X) + 1e-300)
    U, s, V = np.linalg.svd(X * unit, full_matrices=False)
    V = V[s > 1e-6 * s[0]] / s[s > 1e-6 * s[0], None]  # minimum norm if nearly dependent
    solution = V.T @ (space.y @ U)[: len(V)]
    rss = float(np.sum((space.y - (X * unit) @ solution) ** 2))
    variance = max(rss / max(space.freedom - X.shape[1], 1.0), space.floor)
    values = solution * unit
    deviation = np.sqrt(np.einsum("ij,ij->j", V, V) * variance) * unit
    score = float(space.misfit(np.array(rss)) + space.penalty[list(chosen)].sum())
    ends = np.cumsum([0, *(len(space.candidates[c].parameters) for c in chosen)]).tolist()
    slices = [slice(begin, end) for begin, end in pairwise(ends)]
    parts, spread = [values[o] for o in slices], [deviation[o] for o in slices]
    if len(V) >= space.freedom:  # explains anything
        score = np.inf
    families = {"", *(space.candidates[c].family for c in chosen)}
    for c, x, s in zip(chosen, parts, spread, strict=True):
        if space.candidates[c].requires not in families:
            score = np.inf
        if not _plausible(space.candidates[c], x, s):
            score = np.inf
    return CandidateFit(tuple(chosen), score, rss, tuple(parts), tuple(spread))


def _plausible(candidate: Candidate, x: Array, s: Array) -> bool:
    if not candidate.named:
        return True
    if candidate.curve is not None and x.sum() < candidate.parameters[0].lower - s.max():
        return False
    for parameter, value, deviation in zip(candidate.parameters, x, s, strict=True):
        lower = -np.inf if candidate.curve is not None else parameter.lower
        if value < lower - OUT_OF_BOUNDS_SIGMAS * deviation or value > parameter.upper:
            return False
        limit = MAX_TIMES_USUAL * parameter.scale
        if parameter.unit not in SENSOR_UNITS and abs(value) - TOO_LARGE_SIGMAS * deviation > limit:
            return False
    return True
