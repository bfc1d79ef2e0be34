"""Effects missing from a calibration: not asked for, and supported by the poses of the fit.

Each further effect is tried beside all parameters, which move along: what it takes off the
residuals counts, not how it looks beside values that have absorbed a part of it. It counts on poses
that its fit did not see: the poses are left out in folds, those held out of the whole fit are not
looked at.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.converged_fit import FitState
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.problem import HELD, Problem
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.estimation.held_out import missed, pose_groups, random_folds
from gapbridge.core.estimation.least_squares import basis_of, projected_out

MOST = 3  # effects at most
SURE = 6.0  # how much more likely (log) than nothing, the number of effects tried paid for
SMALL = 0.05  # share of the remainder below which an effect is not worth reporting
SHOWN = 1e-6  # share of a column that the parameters leave of it, below which it is one of them
FOLDS = 8
DEPENDENT = 1e-8  # share below which a direction counts as given by the others
FEWEST = 6  # poses, below which no further effect can be judged
CONFIDENCE = 0.99  # one-sided, that an effect gains on poses that its fit did not see
FREE = 1e-9  # ridge on the instrument's numbers, relative to their columns
Candidate = tuple[Array, Array]  # columns (M, k), usual sizes (k,)


@dataclass(frozen=True)
class MissingEffect:
    """An effect that would explain a part of the residuals."""

    name: str  # as identifiable_parameters takes it: backlash_3, thermal_drift
    share: float  # of the residuals' squares on poses left out in folds that it takes off


def missing_effects(problem: Problem, rest: FitState) -> tuple[MissingEffect, ...]:
    """Return the further effects that the poses of the fit support, the strongest first."""
    tried = _columns(problem, rest)
    folds = _Folds.of(problem, rest)
    known = np.hstack([rest.system.J, rest.system.F])
    found: list[MissingEffect] = []
    for _ in range(MOST):
        likely = _likely(tried, known, rest.system.residual, found)
        gains = [(name, folds.gain(tried[name])) for name in likely]
        held = [MissingEffect(name, gain) for name, gain in gains if gain >= SMALL]
        if not held:
            break
        found.append(max(held, key=lambda lack: lack.share))
        known = np.hstack([known, tried[found[-1].name][0]])
        folds = folds.beside(tried[found[-1].name])
    return tuple(found)


def _likely(
    tried: dict[str, Candidate], known: Array, residual: Array, found: list[MissingEffect]
) -> list[str]:
    """Return the effects that are far likelier than nothing, their number paid for."""
    Q = basis_of(known, DEPENDENT)
    free = projected_out(Q, residual)
    whole = max(float(free @ free), 1e-300)
    likely = []
    for name, (columns, _) in tried.items():
        if any(name == lack.name for lack in found):
            continue
        own = projected_out(Q, columns)
        seen = np.linalg.norm(own, axis=0) > SHOWN * np.linalg.norm(columns, axis=0)
        own = basis_of(own[:, seen], DEPENDENT)
        spare = len(residual) - Q.shape[1] - own.shape[1]
        if not own.shape[1] or spare < 1:
            continue
        taken = float(np.sum((own.T @ free) ** 2)) / whole
        cost = 0.5 * own.shape[1] * np.log(spare) + np.log(len(tried))
        if -0.5 * spare * np.log(max(1 - taken, 1e-12)) - cost > SURE:
            likely.append(name)
    return likely


@dataclass(frozen=True)
class _Folds:
    """The fit's linear system with its poses left out in turn."""

    A: Array  # (M, c) columns of parameters and instrument
    target: Array  # (M,) residual, where each number begins taken off
    hold: Array  # (c,) how firmly each number is held there
    pose: NDArray[np.int64]  # (M,) number of each row's pose
    fold: NDArray[np.int64]  # (M,)

    @classmethod
    def of(cls, problem: Problem, rest: FitState) -> _Folds:
        """Return the folds of a converged fit; repeats and loads of a pose stay together."""
        system, held = rest.system, problem.bounds.held
        A = np.hstack([system.J, system.F])
        target = system.residual - system.J @ (problem.bounds.begin - rest.values)
        hold = np.concatenate([1 / held, np.sqrt(FREE) * np.linalg.norm(system.F, axis=0)])
        pose = np.repeat(pose_groups(problem.readings.q), problem.observable.equations)
        return cls(A, target, hold, pose, random_folds(pose, FOLDS))

    def beside(self, candidate: Candidate) -> _Folds:
        """Return the folds of the fit with a further effect in it."""
        columns, sizes = candidate
        hold = np.concatenate([self.hold, 1 / (HELD * sizes)])
        return replace(self, A=np.hstack([self.A, columns]), hold=hold)

    def gain(self, candidate: Candidate) -> float:
        """Return the share of the squares that an effect takes off poses left out of its fit.

        0 where the poses do not agree that it takes any (one-sided t-test over poses).
        """
        count = int(self.pose.max()) + 1
        if count < FEWEST:
            return 0.0
        without = np.bincount(self.pose, self._missed() ** 2)
        gain = without - np.bincount(self.pose, self.beside(candidate)._missed() ** 2)
        spread = float(gain.std(ddof=1)) / np.sqrt(count)
        if gain.mean() <= float(stdtrit(count - 1, CONFIDENCE)) * spread:
            return 0.0
        return float(gain.sum() / max(without.sum(), 1e-300))

    def _missed(self) -> Array:
        """Return what each row misses (M,) where its pose was left out of the fit."""
        return missed(self.A, self.target, self.fold, self.hold)


def _columns(problem: Problem, rest: FitState) -> dict[str, Candidate]:
    """Return the columns and usual sizes of every further effect, weighed as the system is."""
    parameters, observable, readings = problem.parameters, problem.observable, problem.readings
    found = parameters.model(rest.values)
    had = {(t.effect, t.site.joint) for t in parameters.terms}
    effects = [e for e, member in CATALOGUE.items() if member.calibratable]
    every = Parameters.every(found, effects)
    J, _ = observable.columns(every, every.begin, readings, rest.nuisance)
    N, k = len(readings), observable.equations
    J = (rest.noise.whitener @ J.reshape(N, k, -1)).reshape(N * k, -1)
    J = J * np.repeat(np.sqrt(rest.weights), k)[:, None]
    columns: dict[str, list[int]] = {}
    for i, (t, _value) in enumerate(every.place):
        term = every.terms[t]
        if (term.effect, term.site.joint) in had:
            continue
        joint = term.site.joint
        name = term.effect if joint is None else f"{term.effect}_{joint}"
        columns.setdefault(name, []).append(i)
    return {name: (J[:, own], every.scales[own]) for name, own in columns.items()}
