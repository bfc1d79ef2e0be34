"""The nonlinear refit: Levenberg-Marquardt steps on the full prediction, frames included."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import EXTRA_PARAMETER_WEIGHT, MIN_SIGMAS, PRIOR_REACH
from gapbridge.core.diagnosis.selection.candidate import Candidate, jacobian
from gapbridge.core.diagnosis.selection.delay_columns import shrunk_to_common_delay
from gapbridge.core.diagnosis.selection.sample_space import CandidateFit, SampleSpace
from gapbridge.core.diagnosis.selection.state import SelectionState, flat
from gapbridge.core.effects import CATALOGUE, Term
from gapbridge.core.errors import EquilibriumError, InputError
from gapbridge.core.estimation.held_out import jackknife, leave_one_out
from gapbridge.core.estimation.least_squares import (
    basis_of,
    inverse,
    inverse_lengths,
    projected_out,
    solve,
    squared_sigmas,
)

REFITS = 8
DAMPINGS = (0.0, 1e-6, 1e-4, 1e-2, 1.0)  # of the strongest column, in usual sizes, squared
CONVERGED = 1e-3  # squared length of the last step, in its standard deviations
ROUNDING = 1e-13  # of the largest eigenvalue of a covariance
NO_PRIOR: Mapping[int, Array] = {}
NO_START: Mapping[int, Term] = {}


@dataclass(frozen=True)
class UnnamedPart:
    """Unnamed functions fitted together with the causes, and the regions of the scatter."""

    columns: Array  # (m, d) rows of the sample space
    sigma: Array  # (d,) prior 1 sigma of each value, relative to the scatter; inf: free
    region: NDArray[np.int64]  # (m,) region or stretch of each row

    def rows(self) -> Array:
        """Return the prior as rows (f, d) of a regression whose right-hand side is zero."""
        known = np.isfinite(self.sigma)
        return np.asarray(np.diag(1 / np.maximum(self.sigma, 1e-300))[known])

    def scatter_alone(self) -> UnnamedPart:
        """Return the same regions without functions."""
        return replace(self, columns=self.columns[:, :0], sigma=self.sigma[:0])


def refit(
    state: SelectionState,
    space: SampleSpace,
    linear_fit: CandidateFit,
    links: Mapping[int, Array] = NO_PRIOR,
    unnamed_part: UnnamedPart | None = None,
    start: Mapping[int, Term] = NO_START,
) -> tuple[SelectionState, tuple[Term, ...], tuple[int, ...], tuple[Array, ...], Array]:
    """Refit the named terms on the full prediction; smooth ones stay linear, frames are refitted.

    ``links`` are further candidates with a prior 1 sigma of each parameter. ``start``: terms of
    candidates to start from, instead of the linear fit's values. With an ``unnamed_part``
    covariances are those of regions held out in turn (jackknife) where these are
    wider than those of white noise, because an unknown effect differs among regions.
    """
    index = (*(c for c in linear_fit.chosen if space.candidates[c].named), *links)
    fitted = [with_free_shape(state.arm, space.candidates[c]) for c in index]
    prior_sigma = [links.get(c, PRIOR_REACH * k.scales) for c, k in zip(index, fitted, strict=True)]
    extra = space.columns([c for c in linear_fit.chosen if not space.candidates[c].named])
    if unnamed_part is not None:
        extra = np.hstack([extra, unnamed_part.columns])
    linear = _linear_values(space, linear_fit, fitted)
    x = [
        np.array(start[c].values[: len(v)]) if c in start else v
        for c, v in zip(index, linear, strict=True)
    ]
    x = _start_values(state, fitted, x)
    for _ in range(REFITS):
        rows = _linearised(state, fitted, x, extra, prior_sigma, unnamed_part)
        step, trial = _descended(state, fitted, x, rows, prior_sigma)
        if trial is None:
            break
        change = np.concatenate([*trial, np.zeros(0)]) - np.concatenate([*x, np.zeros(0)])
        moved = rows.A[:, : len(change)] @ change
        x = trial
        state = _frame_moved(state, extra, _terms(fitted, x))
        if moved @ moved < CONVERGED * rows.variance(step, space.floor):
            break
    covariance = _covariances(
        *rows.with_prior(), rows.variance(step, space.floor), [len(v) for v in x],
        None if unnamed_part is None or not len(index) else unnamed_part.region,
        _uncertain(state, _terms(fitted, x), len(rows.b) + len(rows.prior_target)),
    )  # fmt: skip
    x, covariance = _as_one_delay(fitted, x, covariance)
    terms = _terms(fitted, x)
    gap = state.observation.measured - state.observation.predict(terms)
    if state.observation.nuisance.shape[2]:
        gap = gap - state.observation.nuisance @ _nuisance_step(extra, gap, state)
    return state, terms, index, tuple(covariance), gap


def _terms(fitted: list[Candidate], x: list[Array]) -> tuple[Term, ...]:
    """Return the terms of candidates at the values ``x`` (d,) of each."""
    return tuple(c.term(v) for c, v in zip(fitted, x, strict=True))


def _linear_values(
    space: SampleSpace, linear_fit: CandidateFit, fitted: list[Candidate]
) -> list[Array]:
    """Return the values (d,) of a linear fit's named terms, and nominal values of the links."""
    x = [
        np.array(space.candidates[c].term(v).values)
        for c, v in zip(linear_fit.chosen, linear_fit.values, strict=True)
        if space.candidates[c].named
    ]
    x += [np.zeros(len(c.parameters)) for c in fitted[len(x) :]]
    return [v[: len(c.parameters)] for c, v in zip(fitted, x, strict=True)]


def _start_values(state: SelectionState, fitted: list[Candidate], x: list[Array]) -> list[Array]:
    """Return start values (d,) of each term: nominal ones if the linear ones have no equilibrium.

    With the linear values of flexibilities the arm might buckle under its load.
    """
    x = [_within(c, v) for c, v in zip(fitted, x, strict=True)]
    try:
        state.observation.predict(_terms(fitted, x))
    except EquilibriumError:
        return [_within(c, np.zeros(len(v))) for c, v in zip(fitted, x, strict=True)]
    return x


@dataclass(frozen=True)
class _Linearised:
    """The whitened rows of one Gauss-Newton step, and the rows of the priors."""

    A: Array  # (m, p) Jacobian: terms, unnamed functions, nuisance
    b: Array  # (m,) gap
    prior: Array  # (f, p) rows of the priors, towards nominal values
    prior_target: Array  # (f,)

    def with_prior(self) -> tuple[Array, Array]:
        """Return all rows (m + f, p) and their right-hand side (m + f,)."""
        return np.vstack([self.A, self.prior]), np.concatenate([self.b, self.prior_target])

    def variance(self, step: Array, floor: float) -> float:
        """Return the residual variance of a row after a step (p,), at least ``floor``."""
        return _variance(self.b - self.A @ step, len(self.b) - self.A.shape[1], floor)


def _variance(residual: Array, freedom: float, floor: float) -> float:
    """Return the variance of a residual (m,) with so many degrees of freedom, at least floor."""
    return float(max(float(residual @ residual) / max(freedom, 1.0), floor))


def _linearised(
    state: SelectionState, fitted: list[Candidate], x: list[Array], extra: Array,
    prior_sigma: list[Array], unnamed_part: UnnamedPart | None,
) -> _Linearised:  # fmt: skip
    """Return the regression at the values ``x``, with unnamed columns ``extra`` (m, e)."""
    observation, terms = state.observation, _terms(fitted, x)
    gap = observation.measured - observation.predict(terms)
    blocks = [
        flat(jacobian(observation, c, x[k], terms[:k] + terms[k + 1 :]), state)
        for k, c in enumerate(fitted)
    ]
    nuisance = flat(observation.nuisance, state)
    A = np.hstack([*blocks, extra, nuisance])
    prior, prior_target = _prior_rows(prior_sigma, x, A.shape[1], unnamed_part, nuisance.shape[1])
    return _Linearised(A, flat(gap[..., None], state)[:, 0], prior, prior_target)


def _frame_moved(state: SelectionState, extra: Array, terms: tuple[Term, ...]) -> SelectionState:
    """Return the state with its frame refitted, given the terms."""
    observation = state.observation
    if observation.rebase is None:
        return state
    gap = observation.measured - observation.predict(terms)
    return replace(state, observation=observation.rebased(_nuisance_step(extra, gap, state), terms))


@dataclass(frozen=True)
class LinearisedTerms:
    """The regression of some terms about their values: fits without some of them, to first order.

    The rows may be few, with the sums of products of many.
    """

    fitted: list[Candidate]
    x: list[Array]  # (d,) of each term, about which the rows are linearised
    prior_sigma: list[Array]  # (d,) of each term, about nominal
    A: Array  # (m, p) whitened Jacobian: terms, nuisance
    b: Array  # (m,) gap
    region: NDArray[np.int64] | None  # (m,) region of each row; None: no scatter among regions
    count: float  # number of the original rows
    floor: float  # least variance of a row

    def alone(self, kept: Sequence[int]) -> tuple[list[Array], list[Array]]:
        """Return values (d,) and covariances (d, d) of some of the terms, without the others."""
        begin = np.cumsum([0, *(len(v) for v in self.x)])
        own = [np.arange(begin[k], begin[k + 1]) for k in kept]
        removed = np.setdiff1d(np.arange(begin[-1]), np.concatenate([*own, np.zeros(0)]))
        columns = np.concatenate([*own, np.arange(begin[-1], self.A.shape[1])]).astype(int)
        A = self.A[:, columns]
        b = self.b + self.A[:, removed] @ np.concatenate([*self.x, np.zeros(0)])[removed]
        fitted, x = [self.fitted[k] for k in kept], [self.x[k] for k in kept]
        prior_sigma = [self.prior_sigma[k] for k in kept]
        prior, prior_target = _prior_rows(prior_sigma, x, A.shape[1], None, 0)
        whole, target = np.vstack([A, prior]), np.concatenate([b, prior_target])
        step = _step(whole, target, inverse_lengths(whole), fitted, x)
        sizes = [len(v) for v in x]
        parts = np.split(step, np.cumsum(sizes))[: len(x)]
        values = [_within(c, v + part) for c, v, part in zip(fitted, x, parts, strict=True)]
        variance = _variance(b - A @ step, self.count - A.shape[1], self.floor)
        return _as_one_delay(
            fitted, values, _covariances(whole, target, variance, sizes, self.region)
        )


def linearised_terms(
    state: SelectionState, candidates: list[Candidate], terms: Sequence[Term],
    links: Sequence[Array | None], region: NDArray[np.int64] | None, floor: float,
) -> LinearisedTerms:  # fmt: skip
    """Return the regression of terms about their values, as few rows of each region (m,).

    ``links`` are prior 1 sigma (d,) of each term's parameters, None of what is no link.
    """
    fitted = [with_free_shape(state.arm, c) for c in candidates]
    x = [np.array(t.values[: len(c.scales)]) for c, t in zip(fitted, terms, strict=True)]
    no_functions = np.zeros((int(state.kept.sum()) * state.observation.measured.shape[1], 0))
    prior_sigma = [
        PRIOR_REACH * c.scales if own is None else own for c, own in zip(fitted, links, strict=True)
    ]
    rows = _linearised(state, fitted, x, no_functions, prior_sigma, None)
    whole = np.column_stack([rows.A, rows.b])
    part = np.zeros(len(whole), dtype=np.int64) if region is None else region
    names = np.unique(part)
    few = [np.asarray(np.linalg.qr(whole[part == name], mode="r")) for name in names]
    named = None if region is None else np.repeat(names, [len(r) for r in few])
    short = np.vstack(few)
    return LinearisedTerms(
        fitted, x, prior_sigma, short[:, :-1], short[:, -1], named, float(len(whole)), floor
    )


def _as_one_delay(
    fitted: list[Candidate], x: list[Array], covariance: list[Array]
) -> tuple[list[Array], list[Array]]:
    """Return values (d,) and covariances (d, d), delays shrunk to the common delay."""
    late = [k for k, c in enumerate(fitted) if c.effect.is_delay]
    variances = np.array([covariance[k][0, 0] for k in late])
    values, variances = shrunk_to_common_delay(np.array([x[k][0] for k in late]), variances)
    x, covariance = list(x), list(covariance)
    for k, value, variance in zip(late, values, variances, strict=True):
        x[k], covariance[k] = np.array([value]), np.array([[variance]])
    return x, covariance


def _covariances(
    rows: Array, target: Array, variance: float, sizes: list[int],
    region: NDArray[np.int64] | None, model_sigmas: Array | None = None,
) -> list[Array]:  # fmt: skip
    """Return the covariance (d, d) of each term from the rows (m, p) of the regression.

    ``model_sigmas`` (m, r) are 1-sigma changes of the rows by the model's own fitted parameters.
    """
    white_noise = inverse(rows.T @ rows)
    spread = white_noise * variance
    if region is not None:
        spread = _cluster_covariance(spread, rows, target, region)
    if model_sigmas is not None:
        change = white_noise @ (rows.T @ model_sigmas)
        spread = spread + change @ change.T
    begin = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    return [spread[i:j, i:j] for i, j in itertools.pairwise(begin)]


def _uncertain(state: SelectionState, terms: tuple[Term, ...], rows: int) -> Array | None:
    """Return 1-sigma changes (rows, r) by the cell's fitted parameters; 0 in the prior's rows."""
    uncertain = state.observation.uncertain
    if uncertain is None or not terms:
        return None
    sigmas = flat(uncertain(terms), state)
    return np.vstack([sigmas, np.zeros((rows - len(sigmas), sigmas.shape[1]))])


def _cluster_covariance(white_noise: Array, A: Array, b: Array, region: NDArray[np.int64]) -> Array:
    """Return the jackknife covariance (p, p) over regions, nowhere less than ``white_noise``.

    ``A`` (m, p) are the rows of the regression; rows after ``region`` are never left out.
    """
    without = np.array([x for _, x in leave_one_out(A, b, region)])
    from scipy.special import ndtri, stdtrit  # slow to import

    # few regions: normal distribution with the 95 % interval of Student's t
    factor = float(stdtrit(max(len(without) - 1, 1), 0.975) / ndtri(0.975))
    return _no_narrower(factor**2 * jackknife(without), white_noise)


def _no_narrower(scatter: Array, white_noise: Array) -> Array:
    """Return a covariance (p, p) at least as wide as either of two in every direction."""
    size = np.sqrt(np.maximum(np.diag(white_noise), 0.0))
    unit = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
    value, V = np.linalg.eigh(white_noise * np.outer(unit, unit))
    root = np.sqrt(np.maximum(value, ROUNDING * value.max(initial=0.0)))
    root = np.where(root > 0, root, 1.0)
    inside = (V / root).T @ (scatter * np.outer(unit, unit)) @ (V / root)
    share, U = np.linalg.eigh(inside)
    factor_matrix = size[:, None] * ((V * root) @ U)
    return np.asarray((factor_matrix * np.maximum(share, 1.0)) @ factor_matrix.T)


def worth(term: Term, spread: Array) -> float:
    """Return the significance of a term with covariance (d, d); from 1 on it is significant.

    The smaller one of the whole term and of its most significant parameter. Of a periodic line
    that is the amplitude; parameters of shape do not count, but 0 is returned where one is not
    identifiable: a Stribeck velocity of 10 +- 50 rad/s is Coulomb friction, a stiffness curve
    without curvature an axial compliance.
    """
    effect, value = CATALOGUE[term.effect], np.array(term.values[: len(spread)])
    if effect.has_nonlinearity and value[-1] <= 0.0:
        return 0.0
    if effect.start_values and len(value) > 1 and spread[-1, -1] > value[-1] ** 2:
        return 0.0
    whole = squared_sigmas(value, spread) / (1 + EXTRA_PARAMETER_WEIGHT * (len(value) - 1))
    if effect.periodic:
        single = float(value @ value) ** 2 / max(float(value @ spread @ value), 1e-300)
    else:
        judged = slice(0, 1) if effect.has_nonlinearity or effect.start_values else slice(None)
        single = float(np.max(value[judged] ** 2 / np.maximum(np.diag(spread)[judged], 1e-300)))
    return min(whole, single) / MIN_SIGMAS**2


def _step(A: Array, b: Array, unit: Array, fitted: list[Candidate], x: list[Array]) -> Array:
    """Return the Gauss-Newton step (k,) with parameters on a bound fixed that would leave it.

    A step that is clipped afterwards might not reduce the residual, and the fit would stop.
    """
    parameters = [p for c in fitted for p in c.parameters]
    now = np.concatenate([*x, np.zeros(0)])
    lower, upper = (np.array([getattr(p, end) for p in parameters]) for end in ("lower", "upper"))
    free = np.ones(len(unit), dtype=bool)
    step = np.zeros(len(unit))
    for _ in range(1 + len(now)):
        unit_of_free = unit * free
        step = np.linalg.lstsq(A * unit_of_free, b, rcond=1e-9)[0] * unit_of_free
        change = step[: len(now)]
        at_bound = ((now <= lower) & (change < 0)) | ((now >= upper) & (change > 0))
        if not at_bound.any():
            break
        free[: len(now)] &= ~at_bound
    return step


def _nuisance_step(extra: Array, gap: Array, state: SelectionState) -> Array:
    """Return the nuisance (p,) fitted to a gap (N, k) together with unnamed functions."""
    b, nuisance = flat(gap[..., None], state)[:, 0], flat(state.observation.nuisance, state)
    return solve(np.hstack([extra, nuisance]), b)[extra.shape[1] :]


def _prior_rows(
    prior_sigma: list[Array],
    x: list[Array],
    width: int,
    unnamed_part: UnnamedPart | None,
    nuisance: int,
) -> tuple[Array, Array]:
    """Return the rows (k, width) and targets of the priors of parameters ``x``.

    ``prior_sigma`` is 1 sigma of each from nominal. If wide, it only acts on combinations that the
    data do not determine, as lengths along parallel axes. The prior of ``unnamed_part``, whose
    columns are before the last ``nuisance`` ones, is appended.
    """
    size = np.concatenate([*prior_sigma, np.zeros(0)])
    rows = np.zeros((len(size), width))
    rows[np.arange(len(size)), np.arange(len(size))] = 1 / size
    prior_target = -np.concatenate([*x, np.zeros(0)]) / size
    if unnamed_part is None:
        return rows, prior_target
    known = unnamed_part.rows()
    end = width - nuisance
    more = np.zeros((len(known), width))
    more[:, end - known.shape[1] : end] = known
    return np.vstack([rows, more]), np.concatenate([prior_target, np.zeros(len(known))])


def _descended(
    state: SelectionState, fitted: list[Candidate], x: list[Array], rows: _Linearised,
    prior_sigma: list[Array],
) -> tuple[Array, list[Array] | None]:  # fmt: skip
    """Return the Gauss-Newton step (p,), and each term's values (d,) after the least damped step.

    The least damped that does not increase the residual (Levenberg-Marquardt; None: there is none).
    A direction that the rows hardly determine takes a step too long for the linearisation, and
    would hold up all others if the whole step was shortened.
    """
    whole, target = rows.with_prior()
    count = sum(len(v) for v in x)
    Q = basis_of(whole[:, count:])  # unnamed functions and nuisance, refitted for each trial

    def objective(trial: list[Array]) -> float:
        try:
            gap = state.observation.measured - state.observation.predict(_terms(fitted, trial))
        except InputError:
            return float("inf")
        from_nominal = -np.concatenate([v / s for v, s in zip(trial, prior_sigma, strict=True)])
        unnamed = np.zeros(len(target) - len(rows.b) - count)
        r = np.concatenate([flat(gap[..., None], state)[:, 0], from_nominal, unnamed])
        r = projected_out(Q, r)
        return float(r @ r)

    R = np.asarray(np.linalg.qr(np.column_stack([whole, target]), mode="r"))
    A, b = R[:, :-1], R[:, -1]
    unit, size = inverse_lengths(A), np.concatenate([*prior_sigma, np.zeros(0)])
    strongest = float((np.sqrt(np.sum(A[:, :count] ** 2, axis=0)) * size).max(initial=0.0))

    def step(damping: float) -> Array:
        damped = np.vstack([A, np.zeros((count, A.shape[1]))])
        damped[len(A) :, :count] = np.diag(np.sqrt(damping) * strongest / size)
        return _step(damped, np.concatenate([b, np.zeros(count)]), unit, fitted, x)

    plain = step(0.0)
    if not fitted:
        return plain, x
    now = objective(x)
    for damping in DAMPINGS:
        parts = np.split(step(damping) if damping else plain, np.cumsum([len(v) for v in x]))
        trial = [_within(c, v + part) for c, v, part in zip(fitted, x, parts, strict=False)]
        if objective(trial) <= now:
            return plain, trial
    return plain, None


def with_free_shape(arm: Arm, candidate: Candidate) -> Candidate:
    """Return the candidate with all parameters free, also those fixed in its columns."""
    if not (candidate.effect.has_nonlinearity or candidate.effect.start_values):
        return candidate
    parameters = candidate.whole or candidate.effect.parameters(arm, candidate.site)
    return replace(candidate, parameters=parameters, fixed=(None,) * len(parameters), curve=None)


def _within(candidate: Candidate, x: Array) -> Array:
    lower = np.array([p.lower for p in candidate.parameters])
    upper = np.array([p.upper for p in candidate.parameters])
    return np.asarray(np.clip(x, lower, upper))
