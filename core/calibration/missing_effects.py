"""Effects missing from a calibration: not requested, but supported by the fitted poses.

Each further effect is fitted together with all parameters, and judged by the reduction of the
residuals in cross-validation over the fitted poses. The held-out poses of the session are not used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.converged_fit import FitState
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.problem import PRIOR_SIZES, Problem
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.estimation.held_out import held_out_residual, pose_groups, random_folds
from gapbridge.core.estimation.least_squares import basis_of, projected_out

MAX_EFFECTS = 3
MIN_LOG_RATIO = 6.0  # log likelihood ratio, less the penalty for the number of effects tried
MIN_SHARE = 0.05  # share of the residual's squares that an effect must remove to be reported
MIN_COLUMN_SHARE = 1e-6  # share of a column that must be independent of the parameters
FOLDS = 8
DEPENDENT = 1e-8  # relative singular value below which a direction is dependent
MIN_POSES = 6
CONFIDENCE = 0.99  # one-sided, of the gain on poses left out
RIDGE = 1e-9  # ridge on the instrument's numbers, relative to their columns
Candidate = tuple[Array, Array]  # columns (M, k), usual sizes (k,)


@dataclass(frozen=True)
class MissingEffect:
    """An effect that would explain a part of the residuals."""

    name: str  # as identifiable_parameters takes it: backlash_3, thermal_drift
    share: float  # of the squared residuals of poses left out in folds that it removes


def missing_effects(problem: Problem, state: FitState) -> tuple[MissingEffect, ...]:
    """Return the further effects that the poses of the fit support, the strongest first."""
    tried = _candidate_columns(problem, state)
    folds = _Folds.of(problem, state)
    known = np.hstack([state.system.J, state.system.F])
    effects: list[MissingEffect] = []
    for _ in range(MAX_EFFECTS):
        likely = _likely_effects(tried, known, state.system.residual, effects)
        gains = [(name, folds.gain(tried[name])) for name in likely]
        confirmed = [MissingEffect(name, gain) for name, gain in gains if gain >= MIN_SHARE]
        if not confirmed:
            break
        effects.append(max(confirmed, key=lambda effect: effect.share))
        known = np.hstack([known, tried[effects[-1].name][0]])
        folds = folds.with_candidate(tried[effects[-1].name])
    return tuple(effects)


def _likely_effects(
    tried: dict[str, Candidate], known: Array, residual: Array, effects: list[MissingEffect]
) -> list[str]:
    """Return the effects with a sufficient likelihood ratio, after the penalties."""
    Q = basis_of(known, DEPENDENT)
    residual_left = projected_out(Q, residual)
    square = max(float(residual_left @ residual_left), 1e-300)
    likely = []
    for name, (columns, _) in tried.items():
        if any(name == effect.name for effect in effects):
            continue
        columns_left = projected_out(Q, columns)
        size = np.linalg.norm(columns, axis=0)
        visible = np.linalg.norm(columns_left, axis=0) > MIN_COLUMN_SHARE * size
        basis = basis_of(columns_left[:, visible], DEPENDENT)
        freedom = len(residual) - Q.shape[1] - basis.shape[1]
        if not basis.shape[1] or freedom < 1:
            continue
        explained = float(np.sum((basis.T @ residual_left) ** 2)) / square
        cost = 0.5 * basis.shape[1] * np.log(freedom) + np.log(len(tried))
        if -0.5 * freedom * np.log(max(1 - explained, 1e-12)) - cost > MIN_LOG_RATIO:
            likely.append(name)
    return likely


@dataclass(frozen=True)
class _Folds:
    """The fit's linear system with its poses left out in turn."""

    A: Array  # (M, c) columns of parameters and instrument
    target: Array  # (M,) residual with every number at its start
    ridge: Array  # (c,) inverse prior sigma of each number
    pose: NDArray[np.int64]  # (M,) number of each row's pose
    fold: NDArray[np.int64]  # (M,)

    @classmethod
    def of(cls, problem: Problem, state: FitState) -> _Folds:
        """Return the folds of a converged fit; repeats and loads of a pose stay together."""
        system, prior_std = state.system, problem.bounds.prior_std
        A = np.hstack([system.J, system.F])
        target = system.residual - system.J @ (problem.bounds.begin - state.values)
        ridge = np.concatenate([1 / prior_std, np.sqrt(RIDGE) * np.linalg.norm(system.F, axis=0)])
        pose = np.repeat(pose_groups(problem.readings.q), problem.observable.equations)
        return cls(A, target, ridge, pose, random_folds(pose, FOLDS))

    def with_candidate(self, candidate: Candidate) -> _Folds:
        """Return the folds of the fit with a further effect in it."""
        columns, sizes = candidate
        ridge = np.concatenate([self.ridge, 1 / (PRIOR_SIZES * sizes)])
        return replace(self, A=np.hstack([self.A, columns]), ridge=ridge)

    def gain(self, candidate: Candidate) -> float:
        """Return the share of the squared residuals of left-out poses that an effect removes.

        0 where it is not significant (one-sided t-test over poses).
        """
        count = int(self.pose.max()) + 1
        if count < MIN_POSES:
            return 0.0
        without = np.bincount(self.pose, self._held_out_residual() ** 2)
        fitted = self.with_candidate(candidate)._held_out_residual()
        gain = without - np.bincount(self.pose, fitted**2)
        spread = float(gain.std(ddof=1)) / np.sqrt(count)
        if gain.mean() <= float(stdtrit(count - 1, CONFIDENCE)) * spread:
            return 0.0
        return float(gain.sum() / max(without.sum(), 1e-300))

    def _held_out_residual(self) -> Array:
        """Return the residual of each row (M,) by the fit without its pose."""
        return held_out_residual(self.A, self.target, self.fold, self.ridge)


def _candidate_columns(problem: Problem, state: FitState) -> dict[str, Candidate]:
    """Return the columns and usual sizes of every further effect, weighted as the system."""
    parameters, observable, readings = problem.parameters, problem.observable, problem.readings
    fitted = {(t.effect, t.site.joint) for t in parameters.terms}
    names = [e for e, member in CATALOGUE.items() if member.calibratable]
    candidates = Parameters.of_effects(parameters.model(state.values), names)
    J, _ = observable.columns(candidates, candidates.begin, readings, state.nuisance)
    N, k = len(readings), observable.equations
    J = (state.noise.whitener @ J.reshape(N, k, -1)).reshape(N * k, -1)
    J = J * np.repeat(np.sqrt(state.weights), k)[:, None]
    columns: dict[str, list[int]] = {}
    for i, (t, _value) in enumerate(candidates.place):
        term = candidates.terms[t]
        if (term.effect, term.site.joint) in fitted:
            continue
        joint = term.site.joint
        name = term.effect if joint is None else f"{term.effect}_{joint}"
        columns.setdefault(name, []).append(i)
    return {name: (J[:, rows], candidates.scales[rows]) for name, rows in columns.items()}
