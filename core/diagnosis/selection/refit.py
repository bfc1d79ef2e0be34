"""The exact refit: Gauss-Newton on the whole prediction, frames and all."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import OWN_SIGMAS, PRIOR_REACH
from gapbridge.core.diagnosis.selection.candidate import Candidate, jacobian
from gapbridge.core.diagnosis.selection.delay_columns import as_one_delay
from gapbridge.core.diagnosis.selection.problem import CandidateFit, SampleSpace
from gapbridge.core.diagnosis.selection.state import SelectionState, flat
from gapbridge.core.effects import CATALOGUE, Term
from gapbridge.core.errors import EquilibriumError, InputError
from gapbridge.core.estimation.held_out import jackknife, leave_one_out
from gapbridge.core.estimation.least_squares import (
    basis_of,
    inverse,
    projected_out,
    solve,
    squared_sigmas,
)

REFITS = 8
CONVERGED = 1e-6  # usual sizes of a number that the last step moved
LEAST = 1e-13  # of the largest eigenvalue of a covariance: what is less is rounding
NO_PRIOR: Mapping[int, Array] = {}


@dataclass(frozen=True)
class Remainder:
    """Unnamed functions that stand beside the causes, and the regions that scatter is judged by."""

    columns: Array  # (m, d) rows of the sample space
    sigma: Array  # (d,) prior 1 sigma of each value over the scatter of the rows; inf: free
    region: NDArray[np.int64]  # (m,) region or stretch of each row

    def rows(self) -> Array:
        """Return the prior as rows (f, d) of a regression whose right-hand side is zero."""
        known = np.isfinite(self.sigma)
        return np.asarray(np.diag(1 / np.maximum(self.sigma, 1e-300))[known])

    def scatter_alone(self) -> Remainder:
        """Return the same without functions: the scatter among regions stays."""
        return replace(self, columns=self.columns[:, :0], sigma=self.sigma[:0])


def refit(
    state: SelectionState,
    space: SampleSpace,
    linear_fit: CandidateFit,
    links: Mapping[int, Array] = NO_PRIOR,
    remainder: Remainder | None = None,
) -> tuple[SelectionState, tuple[Term, ...], tuple[int, ...], tuple[Array, ...], Array]:
    """Refit the named terms exactly, smooth ones kept linear; the state's frame moves along.

    ``links`` are further candidates, with 1 sigma of each number: these are kept near nominal.
    Beside a ``remainder`` covariances are those of regions left out in turn (jackknife), where
    these are wider than those of white noise: what is unknown is not the same everywhere.
    """
    index = (*(c for c in linear_fit.chosen if space.candidates[c].named), *links)
    freed = [freed_of(state.arm, space.candidates[c]) for c in index]
    usual = [links.get(c, PRIOR_REACH * k.scales) for c, k in zip(index, freed, strict=True)]
    near = [links.get(c, np.inf) for c in index]
    extra = space.columns([c for c in linear_fit.chosen if not space.candidates[c].named])
    if remainder is not None:
        extra = np.hstack([extra, remainder.columns])
    x = _start_values(state, freed, _linear_values(space, linear_fit, freed))
    for _ in range(REFITS):
        rows = _linearised(state, freed, x, extra, usual, remainder)
        step = _step(*rows.with_prior(), rows.unit(), freed, x)
        parts = np.split(step, np.cumsum([len(v) for v in x]))[: len(x)]
        share = _share(state, freed, x, parts, near, rows.A)
        x = [_within(c, v + share * part) for c, v, part in zip(freed, x, parts, strict=True)]
        state = _frame_moved(state, extra, _terms(freed, x))
        if _largest_step(freed, parts) < CONVERGED:
            break
    covariance = _covariances(
        *rows.with_prior(), rows.variance(step, space.floor), [len(v) for v in x],
        None if remainder is None or not len(index) else remainder.region,
        _uncertain(state, _terms(freed, x), len(rows.b) + len(rows.towards)),
    )  # fmt: skip
    x, covariance = _as_one_delay(freed, x, covariance)
    terms = _terms(freed, x)
    gap = state.observation.measured - state.observation.predict(terms)
    if state.observation.nuisance.shape[2]:
        gap = gap - state.observation.nuisance @ _along(extra, gap, state)
    return state, terms, index, tuple(covariance), gap


def _terms(freed: list[Candidate], x: list[Array]) -> tuple[Term, ...]:
    """Return the terms of candidates at the values ``x`` (d,) of each."""
    return tuple(c.term(v) for c, v in zip(freed, x, strict=True))


def _linear_values(
    space: SampleSpace, linear_fit: CandidateFit, freed: list[Candidate]
) -> list[Array]:
    """Return the values (d,) of a linear fit's named terms, and nominal ones of the links."""
    x = [
        np.array(space.candidates[c].term(v).values)
        for c, v in zip(linear_fit.chosen, linear_fit.values, strict=True)
        if space.candidates[c].named
    ]
    x += [np.zeros(len(c.parameters)) for c in freed[len(x) :]]
    return [v[: len(c.parameters)] for c, v in zip(freed, x, strict=True)]


def _start_values(state: SelectionState, freed: list[Candidate], x: list[Array]) -> list[Array]:
    """Return start values (d,) of each term: nominal ones where no arm of the linear ones stands.

    Linear values of flexibilities may be such that the arm would buckle under its load.
    """
    try:
        state.observation.predict(_terms(freed, x))
    except EquilibriumError:
        return [_within(c, np.zeros(len(v))) for c, v in zip(freed, x, strict=True)]
    return x


@dataclass(frozen=True)
class _Linearised:
    """The whitened rows of one Gauss-Newton step, and those of the priors."""

    A: Array  # (m, p) Jacobian: terms, unnamed functions, nuisance
    b: Array  # (m,) gap
    pull: Array  # (f, p) priors, which pull towards nominal
    towards: Array  # (f,)

    def with_prior(self) -> tuple[Array, Array]:
        """Return all rows (m + f, p) and their right-hand side (m + f,)."""
        return np.vstack([self.A, self.pull]), np.concatenate([self.b, self.towards])

    def unit(self) -> Array:
        """Return one over each column's size (p,); 0 of a column that moves nothing.

        Priors count: what the data do not show is as large as its prior, and hides no other.
        """
        squares = [np.einsum("ij,ij->j", rows, rows) for rows in (self.A, self.pull)]
        size = np.sqrt(squares[0] + squares[1])
        return np.where(size > 1e-150, 1 / np.maximum(size, 1e-150), 0.0)

    def variance(self, step: Array, floor: float) -> float:
        """Return the variance of a row after a step (p,), no less than ``floor``."""
        residual_ss = float(np.sum((self.b - self.A @ step) ** 2))
        return float(max(residual_ss / max(len(self.b) - self.A.shape[1], 1), floor))


def _linearised(
    state: SelectionState, freed: list[Candidate], x: list[Array], extra: Array,
    usual: list[Array], remainder: Remainder | None,
) -> _Linearised:  # fmt: skip
    """Return the regression at the values ``x``, unnamed functions ``extra`` (m, e) beside them."""
    observation, terms = state.observation, _terms(freed, x)
    gap = observation.measured - observation.predict(terms)
    blocks = [
        flat(jacobian(observation, c, x[k], terms[:k] + terms[k + 1 :]), state)
        for k, c in enumerate(freed)
    ]
    nuisance = flat(observation.nuisance, state)
    A = np.hstack([*blocks, extra, nuisance])
    pull, towards = _pull(usual, x, A.shape[1], remainder, nuisance.shape[1])
    return _Linearised(A, flat(gap[..., None], state)[:, 0], pull, towards)


def _frame_moved(state: SelectionState, extra: Array, terms: tuple[Term, ...]) -> SelectionState:
    """Return the state with its frame where it fits best beside the terms."""
    observation = state.observation
    if observation.rebase is None:
        return state
    gap = observation.measured - observation.predict(terms)
    return replace(state, observation=observation.rebased(_along(extra, gap, state), terms))


def _largest_step(freed: list[Candidate], parts: list[Array]) -> float:
    """Return the largest part (d,) of a step, in its parameter's usual sizes."""
    each = (float(np.abs(part / c.scales).max()) for c, part in zip(freed, parts, strict=True))
    return max(each, default=0.0)


@dataclass(frozen=True)
class Reduced:
    """Whitened rows of a regression, of as many as there were those that hold the same sums."""

    A: Array  # (m, p) Jacobian at the values at hand
    b: Array  # (m,) gap
    region: NDArray[np.int64] | None  # (m,) region of each row, where scatter is judged by regions
    count: float  # rows that there were


def step_on(
    rows: Reduced, freed: list[Candidate], x: list[Array], floor: float
) -> tuple[list[Array], list[Array]]:
    """Return values (d,) and covariances (d, d) of terms after one step from ``x``, near there."""
    pull, towards = _pull([PRIOR_REACH * c.scales for c in freed], x, rows.A.shape[1], None, 0)
    whole, right = np.vstack([rows.A, pull]), np.concatenate([rows.b, towards])
    unit = 1 / np.sqrt(np.einsum("ij,ij->j", whole, whole))
    step = _step(whole, right, unit, freed, x)
    sizes = [len(v) for v in x]
    values = [
        _within(c, v + part)
        for c, v, part in zip(freed, x, np.split(step, np.cumsum(sizes)[:-1]), strict=True)
    ]
    residual_ss = float(np.sum((rows.b - rows.A @ step) ** 2))
    variance = max(residual_ss / max(rows.count - rows.A.shape[1], 1), floor)
    spread = _covariances(whole, right, variance, sizes, rows.region)
    return _as_one_delay(freed, values, spread)


def _as_one_delay(
    freed: list[Candidate], x: list[Array], covariance: list[Array]
) -> tuple[list[Array], list[Array]]:
    """Return values (d,) and covariances (d, d) of terms, delays known by those of other joints."""
    late = [k for k, c in enumerate(freed) if c.effect.delays]
    variances = np.array([covariance[k][0, 0] for k in late])
    values, variances = as_one_delay(np.array([x[k][0] for k in late]), variances)
    x, covariance = list(x), list(covariance)
    for k, value, variance in zip(late, values, variances, strict=True):
        x[k], covariance[k] = np.array([value]), np.array([[variance]])
    return x, covariance


def _covariances(
    rows: Array, right: Array, variance: float, sizes: list[int],
    region: NDArray[np.int64] | None, unsure: Array | None = None,
) -> list[Array]:  # fmt: skip
    """Return the covariance (d, d) of each term by the rows (m, p) of the regression.

    ``unsure`` (m, r) is 1 sigma of the rows by what the model's own numbers leave open.
    """
    white = inverse(rows.T @ rows)
    spread = white * variance
    if region is not None:
        spread = _cluster_covariance(spread, rows, right, region)
    if unsure is not None:
        moved = white @ (rows.T @ unsure)
        spread = spread + moved @ moved.T
    begin = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    return [spread[i:j, i:j] for i, j in itertools.pairwise(begin)]


def _uncertain(state: SelectionState, terms: tuple[Term, ...], rows: int) -> Array | None:
    """Return 1 sigma (rows, r) by what the cell's numbers leave open; of a prior's rows none."""
    uncertain = state.observation.uncertain
    if uncertain is None or not terms:
        return None
    sigmas = flat(uncertain(terms), state)
    return np.vstack([sigmas, np.zeros((rows - len(sigmas), sigmas.shape[1]))])


def _cluster_covariance(white: Array, A: Array, b: Array, region: NDArray[np.int64]) -> Array:
    """Return the covariance (p, p) by leaving out regions, nowhere narrower than ``white``.

    ``A`` (m, p) are the rows of the regression; those after ``region`` always stay.
    """
    without = np.array([x for _, x in leave_one_out(A, b, region)])
    from scipy.special import ndtri, stdtrit  # a fifth of a second, only beside the unknown

    # few regions: as wide as a normal distribution of the same 95 % interval
    few = float(stdtrit(max(len(without) - 1, 1), 0.975) / ndtri(0.975))
    return _no_narrower(few**2 * jackknife(without), white)


def _no_narrower(scatter: Array, white: Array) -> Array:
    """Return a covariance (p, p) that is as wide as either of two, along every direction."""
    size = np.sqrt(np.maximum(np.diag(white), 0.0))
    unit = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
    value, V = np.linalg.eigh(white * np.outer(unit, unit))
    root = np.sqrt(np.maximum(value, LEAST * value.max(initial=0.0)))
    root = np.where(root > 0, root, 1.0)
    inside = (V / root).T @ (scatter * np.outer(unit, unit)) @ (V / root)
    share, U = np.linalg.eigh(inside)
    half = size[:, None] * ((V * root) @ U)
    return np.asarray((half * np.maximum(share, 1.0)) @ half.T)


def worth(term: Term, spread: Array) -> float:
    """Return a term's value, of covariance (d, d), over what makes it a finding (1: just).

    As a whole, and of its numbers the surest: of a line its amplitude, whose phase has any value,
    as has what shapes a curve.
    """
    effect, value = CATALOGUE[term.effect], np.array(term.values[: len(spread)])
    whole = squared_sigmas(value, spread) / len(value)
    if effect.periodic:
        single = float(value @ value) ** 2 / max(float(value @ spread @ value), 1e-300)
    else:
        judged = slice(0, 1) if effect.curved or effect.shapes else slice(None)
        single = float(np.max(value[judged] ** 2 / np.maximum(np.diag(spread)[judged], 1e-300)))
    return min(whole, single) / OWN_SIGMAS**2


def _step(A: Array, b: Array, unit: Array, freed: list[Candidate], x: list[Array]) -> Array:
    """Return the Gauss-Newton step (k,); what stands on a bound and would pass it stays there.

    Cut off afterwards, such a step would no longer be one downhill, and the fit would stand still.
    """
    parameters = [p for c in freed for p in c.parameters]
    now = np.concatenate([*x, np.zeros(0)])
    lower, upper = (np.array([getattr(p, end) for p in parameters]) for end in ("lower", "upper"))
    free = np.ones(len(unit), dtype=bool)
    step = np.zeros(len(unit))
    for _ in range(1 + len(now)):
        unit_of_free = unit * free
        step = np.linalg.lstsq(A * unit_of_free, b, rcond=1e-9)[0] * unit_of_free
        ahead = step[: len(now)]
        stuck = ((now <= lower) & (ahead < 0)) | ((now >= upper) & (ahead > 0))
        if not stuck.any():
            break
        free[: len(now)] &= ~stuck
    return step


def _along(extra: Array, gap: Array, state: SelectionState) -> Array:
    """Return what of the nuisance (p,) a gap (N, k) asks for, unnamed functions beside it."""
    b, nuisance = flat(gap[..., None], state)[:, 0], flat(state.observation.nuisance, state)
    return solve(np.hstack([extra, nuisance]), b)[extra.shape[1] :]


def _pull(
    usual: list[Array], x: list[Array], width: int, remainder: Remainder | None, nuisance: int
) -> tuple[Array, Array]:
    """Return rows (k, width) and targets that pull parameters ``x`` towards nominal.

    ``usual`` is how far each may be from there. Where that is many usual sizes only combinations
    without any trace in the data feel it: lengths along parallel axes, which run off else. What
    the ``remainder`` knows of its own numbers, before the last ``nuisance`` columns, comes with it.
    """
    size = np.concatenate([*usual, np.zeros(0)])
    rows = np.zeros((len(size), width))
    rows[np.arange(len(size)), np.arange(len(size))] = 1 / size
    towards = -np.concatenate([*x, np.zeros(0)]) / size
    if remainder is None:
        return rows, towards
    known = remainder.rows()
    end = width - nuisance
    more = np.zeros((len(known), width))
    more[:, end - known.shape[1] : end] = known
    return np.vstack([rows, more]), np.concatenate([towards, np.zeros(len(known))])


def _share(
    state: SelectionState, freed: list[Candidate], x: list[Array], parts: list[Array],
    near: list[Array | float], A: Array,
) -> float:  # fmt: skip
    """Return the share of a Gauss-Newton step to go: less than all where it would overshoot.

    ``near`` is the prior 1 sigma of each term's numbers; inf: none that counts.
    """
    if not freed:
        return 1.0
    linear = A[:, sum(len(v) for v in x) :]  # smooth terms and nuisance, refitted for each trial
    Q = basis_of(linear)

    def objective(share: float) -> float:
        ahead = [_within(c, v + share * part) for c, v, part in zip(freed, x, parts, strict=True)]
        try:
            gap = state.observation.measured - state.observation.predict(_terms(freed, ahead))
        except InputError:
            return float("inf")
        r = projected_out(Q, flat(gap[..., None], state)[:, 0])
        off = np.concatenate([v / size for v, size in zip(ahead, near, strict=True)])
        return float(r @ r + off @ off)

    now = objective(0.0)
    for share in (1.0, 0.5, 0.25, 0.1, 0.03):
        if objective(share) <= now:
            return share
    return 0.0


def freed_of(arm: Arm, candidate: Candidate) -> Candidate:
    """Return the candidate with what its columns held fixed (a softening) fitted too."""
    if not (candidate.effect.curved or candidate.effect.shapes):
        return candidate
    parameters = candidate.effect.parameters(arm, candidate.site)
    return replace(candidate, parameters=parameters, fixed=(None,) * len(parameters), curve=None)


def _within(candidate: Candidate, x: Array) -> Array:
    lower = np.array([p.lower for p in candidate.parameters])
    upper = np.array([p.upper for p in candidate.parameters])
    return np.asarray(np.clip(x, lower, upper))
