"""The state of a selection: observation, candidates, noise and outliers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import ANY_CONSTANT_PENALTY, KNOWN_SHARE, NO_REVERSAL_PENALTY
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.noise import Noise
from gapbridge.core.diagnosis.selection.sample_space import AT_ONCE, SampleSpace, penalties
from gapbridge.core.effects import CATALOGUE, Term

MIN_REMAINING = 1e-7  # share of a column outside the nuisance; below it is rounding


@dataclass(frozen=True)
class SelectionState:
    """The state of a search; each round makes another."""

    observation: Observation
    arm: Arm
    candidates: list[Candidate]
    noise: Noise
    kept: NDArray[np.bool_]


@dataclass(frozen=True)
class UnprojectedRows:
    """The whitened rows of the kept samples before the nuisance was projected out.

    Columns are computed on request, because all of them are as large as the sample space.
    """

    nuisance: Array  # (m, p)
    target: Array  # (m,)
    basis: Array  # (m, p) orthonormal, of the nuisance
    coefficients: Array  # (p, K) of every column in the basis

    def columns(self, space: SampleSpace, chosen: Sequence[int]) -> Array:
        """Return the unprojected columns (m, sum d) of a set of candidates."""
        coefficients = self.coefficients[:, space.column_indices(chosen)]
        return np.asarray(space.columns(chosen) + self.basis @ coefficients)


def flat(columns: Array, state: SelectionState) -> Array:
    """Return (N, k, d) columns as whitened (m, d) rows of the kept samples."""
    kept = state.noise.whitener[state.kept] @ columns[state.kept]
    return np.asarray(kept.reshape(kept.shape[0] * kept.shape[1], columns.shape[-1]))


def sample_space(
    state: SelectionState,
    columns: list[Array],
    base: tuple[Term, ...],
    smooth: list[tuple[Candidate, Array]],
) -> tuple[SampleSpace, UnprojectedRows]:
    """Return the sample space at the current model ``base``, and its unprojected rows."""
    observation = state.observation
    candidates = [*state.candidates, *(c for c, _ in smooth)]
    size = np.array([len(c.parameters) for c in candidates])
    start = np.concatenate([[0], np.cumsum(size)])
    X = np.empty((int(state.kept.sum()) * observation.measured.shape[1], int(start[-1])))
    blocks = [*columns, *(s for _, s in smooth)]
    for few in np.array_split(np.arange(len(blocks)), 1 + X.size // AT_ONCE):
        if len(few):
            together = np.concatenate([blocks[c] for c in few], axis=2)
            X[:, start[few[0]] : start[few[-1] + 1]] = flat(together, state)
    chords = chords_only(observation, base)
    gap = (observation.measured - observation.predict(() if chords else base))[..., None]
    # the linear part of the terms in the model is added back
    for term in () if chords else base:
        c, x = candidate_of(state.candidates, term)
        gap = gap + columns[c] @ x[:, None]
    target = flat(gap, state)[:, 0]
    nuisance = flat(observation.nuisance, state)
    Q = np.linalg.qr(nuisance)[0] if nuisance.shape[1] else nuisance
    whole = _sizes(X)
    coefficients, y = Q.T @ X, target - Q @ (Q.T @ target)
    for few in np.array_split(np.arange(X.shape[1]), 1 + X.size // AT_ONCE):
        X[:, few] -= Q @ coefficients[:, few]
    X[:, _sizes(X) < MIN_REMAINING * whole] = 0.0  # wholly in the nuisance
    freedom = float(len(target) - Q.shape[1])
    penalty = penalties(candidates, freedom) + np.array(
        [_tie_penalty(c, observation) for c in candidates]
    )
    space = SampleSpace(
        y, X, start, tuple(candidates), penalty, freedom,
        KNOWN_SHARE if observation.sigma_is_whole else state.noise.floor_share,
    )  # fmt: skip
    return space, UnprojectedRows(nuisance, target, Q, coefficients)


def chords_only(observation: Observation, base: Sequence[Term]) -> bool:
    """Return whether all columns are chords from zero: no term's part is added back."""
    delays = all(CATALOGUE[term.effect].is_delay for term in base)
    return observation.channel == "tracking" and delays


def _sizes(X: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("ij,ij->j", X, X)))


def _tie_penalty(candidate: Candidate, observation: Observation) -> float:
    """Return the extra penalty of an effect that another one equals in this log.

    Without reversals, backlash ranks behind the offset. A sensor's constant ranks behind effects
    that are constant at these poses only, because further poses can tell these apart.
    """
    if candidate.effect.fits_any_constant:
        return ANY_CONSTANT_PENALTY
    if not candidate.effect.depends_on_approach or candidate.site.joint is None:
        return 0.0
    reversed_ = f"approach_{candidate.site.joint - 1}" in observation.quantities
    return 0.0 if reversed_ else NO_REVERSAL_PENALTY


def candidate_of(candidates: list[Candidate], term: Term) -> tuple[int, Array]:
    """Return the candidate of a term, and the term's fitted values."""
    for c, candidate in enumerate(candidates):
        if candidate.family == term.effect and candidate.site == term.site:
            if candidate.fixed != (None,) * len(term.values) and not np.allclose(
                [f for f in candidate.fixed if f is not None],
                [v for f, v in zip(candidate.fixed, term.values, strict=True) if f is not None],
            ):
                continue
            free = [v for f, v in zip(candidate.fixed, term.values, strict=True) if f is None]
            return c, np.array(free)
    raise KeyError(term)
