"""A calibration converges: staged, then everything together, then the noise along with it.

None of its steps makes the fit worse (Levenberg, Marquardt). A payload times a flexibility bends
the arm: such products make Gauss and Newton's full steps overshoot. Each step is tried against the
exact prediction; one that gains less than predicted is shortened, most along what the readings
hardly separate (columns scaled to length one, Marquardt, J. SIAM 11 (1963) 431). Derivatives are
computed anew where they predict too much.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.calibration.noise import Noise, estimated, presumed
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.problem import (
    Problem,
    bounds_of,
    cost,
    require_enough,
    weighted_system,
)
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.staging import staged_step, stages_of
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.linear_system import System, joint_covariance, posterior, solve
from gapbridge.core.metrology import Metrology

NOISES = 6  # times at most that the noise is estimated anew
SAME = 0.02  # relative change of the noise that is none
Columns = tuple[Array, Array]
LOOKS = 20  # derivatives taken anew at most
STEPS = 12  # steps tried with the same derivatives at most
MOVED = 0.02  # of its deviation: a smaller step changes nothing that anybody reports
LOOSE = 0.2  # of its deviation: what weights that still sway may leave at the end of patience
STALE = 3.0  # deviations of movement beyond which derivatives are taken anew
KEPT = 0.1  # share of the predicted decrease that an accepted step must reach
POOR = 0.5  # share below which the next step is shorter, with new derivatives
GOOD = 0.8  # share above which the next step may be longer
LEAST, MOST = 1e-4, 1e8  # damping: below it is none; above it nothing is gained any more
DAMPING_FACTOR = 8.0  # by which damping grows after a refused step, and falls after a good one
NOTHING = 1e-6  # of the sum of squares, in which one is a standard deviation: rounding


@dataclass(frozen=True)
class FitState:
    """Where a fit stands, with derivatives that hold there."""

    values: Array  # (p,)
    nuisance: Nuisance
    noise: Noise
    columns: Columns  # J (N*k, p) and F (N*k, m)
    anchor: Array  # (p,) where the derivatives were taken
    system: System  # divided by the noise, weighed
    weights: Array  # (N,) 0 outlier, 1 inlier
    stuck: Mask  # (p,) on a bound
    covariance: Array  # (p, p)
    spent: float  # numbers that the fit spent
    share: Array  # (N,) of them on each reading
    converged: bool  # no step would change anything any more; False: patience ended before

    @property
    def freedom(self) -> float:
        """Return the degrees of freedom left."""
        width = len(self.system.residual) / max(len(self.weights), 1)
        return max(float(self.weights.sum()) * width - self.spent, 1.0)

    @property
    def inliers(self) -> Mask:
        """Return which readings count (N,)."""
        return np.asarray(self.weights > 0)

    def stale(self) -> bool:
        """Return whether the derivatives were taken too far away."""
        return bool(_sizes(self.values - self.anchor, self.covariance) > STALE)


def converged_fit(
    parameters: Parameters,
    observable: Observable,
    readings: Readings,
    metrology: Metrology,
    progress: Callable[[str], None],
) -> tuple[Problem, FitState]:
    """Return the fit of all parameters to the readings.

    Raises ExcitationError where there are fewer readings than numbers to find, InputError where
    the arm finds no equilibrium with what they ask for.
    """
    require_enough(parameters, observable, readings)
    bounds, stages = bounds_of(parameters, readings), stages_of(parameters, readings)
    values = parameters.begin.copy()
    begin = parameters.model(values)
    nuisance = observable.start(begin, readings)
    noise, known = presumed(begin, readings, observable, nuisance, metrology)
    problem = Problem(parameters, observable, readings, bounds, stages, known)
    progress("fitting, look 1")
    at = _staged(problem, fit_state(problem, values, nuisance, noise))
    at = converge(problem, at, noise)
    for look in range(NOISES):  # the noise is determined by what is left once the fit is at rest
        progress(f"fitting, look {look + 2}")
        before, at = at.noise, converge(problem, at, _noise(problem, at))
        if np.abs(at.noise.sizes / before.sizes - 1).max() < SAME:
            break
    covariance = joint_covariance(at.system, bounds, readings.repeats())
    p = len(parameters)
    return problem, replace(at, covariance=covariance[:p, :p])


def _staged(problem: Problem, at: FitState) -> FitState:
    """Return the state after the stages, where they lead down."""
    k = problem.observable.equations
    root = np.sqrt(at.weights)
    step = staged_step(at.system, problem.stages, at.values, problem.bounds, k, root)
    values = np.clip(at.values + step, problem.bounds.lower, problem.bounds.upper)
    if problem.residual(values, at.nuisance) is None:
        return at
    poses = problem.parameters.model(values).predict(problem.readings.q, problem.readings.loads)
    nuisance = problem.observable.refined(poses, problem.readings, at.nuisance)
    here, there = (problem.residual(*p) for p in ((at.values, at.nuisance), (values, nuisance)))
    if here is None or there is None:
        return at
    gain = cost(here, at.noise, at.weights) - cost(there, at.noise, at.weights)
    if gain < problem.prior(values) - problem.prior(at.values):
        return at
    return fit_state(problem, values, nuisance, at.noise, at.columns, at.anchor)


def _noise(problem: Problem, at: FitState) -> Noise:
    """Return the noise that the residual implies."""
    J, F = at.columns
    residual = problem.residual(at.values, at.nuisance)
    assert residual is not None
    off = at.values - problem.bounds.begin
    precision = np.concatenate([problem.bounds.held**-2.0, np.zeros(F.shape[1])])
    return estimated(
        at.noise, problem.known, residual + (J @ off).reshape(residual.shape), np.hstack([J, F]),
        precision, at.inliers,
    )  # fmt: skip


def fit_state(
    problem: Problem, values: Array, nuisance: Nuisance, noise: Noise,
    columns: Columns | None = None, anchor: Array | None = None, share: Array | None = None,
) -> FitState:  # fmt: skip
    """Return the state at ``values``, derivatives taken there where none are given.

    Raises InputError where the arm finds no equilibrium.
    """
    residual = problem.residual(values, nuisance)
    if residual is None:
        raise InputError("the arm finds no equilibrium where the fit begins; expected one")
    if columns is None:
        columns = problem.observable.columns(problem.parameters, values, problem.readings, nuisance)
        anchor = values
    system, weights = weighted_system(residual, noise, columns, share)
    covariance, spent, each = posterior(system, problem.bounds)
    share = each.reshape(residual.shape).sum(axis=1)
    return FitState(
        values, nuisance, noise, columns, values if anchor is None else anchor, system, weights,
        np.zeros(len(values), dtype=bool), covariance, spent, share, False,
    )  # fmt: skip


def converge(problem: Problem, at: FitState, noise: Noise) -> FitState:
    """Return where steps from ``at`` converge under this noise, or where patience ends."""
    damping = 0.0
    at = fit_state(problem, at.values, at.nuisance, noise, at.columns, at.anchor, at.share)
    for _ in range(LOOKS):
        if at.stale():
            at = fit_state(problem, at.values, at.nuisance, noise, share=at.share)
        at, damping, renew = _stepped(problem, at, damping)
        if not renew and ((at.converged and not at.stale()) or damping > MOST):
            break
        if renew:
            at = fit_state(problem, at.values, at.nuisance, noise, share=at.share)
    return at


def _stepped(problem: Problem, at: FitState, damping: float) -> tuple[FitState, float, bool]:
    """Return the state after steps with the same derivatives, and the damping.

    Last comes whether the derivatives predicted too much.
    """
    layout, bounds = problem.observable.layout(problem.readings), problem.bounds
    free = np.ones(len(at.values), dtype=bool)
    size = np.inf
    for _ in range(STEPS):
        step, shift, stuck = solve(at.system, at.values, bounds, free, damping)
        size = _sizes(step, at.covariance)
        small = size < MOVED
        values, nuisance = at.values + step, at.nuisance.moved(shift, layout)
        kept = _kept(problem, at, step, shift, (values, nuisance))
        fresh = bool((at.anchor == at.values).all())
        if kept < KEPT:
            if not fresh:
                return at, damping, True
            if small and damping == 0.0:
                return replace(at, stuck=stuck, converged=True), damping, False
            damping = max(DAMPING_FACTOR * damping, LEAST)
            if damping > MOST:
                return at, damping, False
            continue
        at = fit_state(problem, values, nuisance, at.noise, at.columns, at.anchor, at.share)
        at = replace(at, stuck=stuck, converged=small and damping == 0.0)
        if at.converged:
            return at, damping, False
        if kept < POOR:
            return at, max(damping * 2, LEAST), True
        if kept > GOOD:
            damping = damping / DAMPING_FACTOR if damping > LEAST else 0.0
    converged = size < LOOSE and damping == 0.0
    return replace(at, converged=converged), damping, not converged


def _kept(
    problem: Problem, at: FitState, step: Array, shift: Array, trial: tuple[Array, Nuisance]
) -> float:
    """Return the actual over the predicted decrease of a step; 1 where none is predicted."""
    before = float(at.system.residual @ at.system.residual) + problem.prior(at.values)
    rest = at.system.residual - at.system.J @ step - at.system.F @ shift
    predicted = before - float(rest @ rest) - problem.prior(trial[0])
    residual = problem.residual(*trial)
    if residual is None:
        return -1.0
    found = before - cost(residual, at.noise, at.weights) - problem.prior(trial[0])
    tiny = NOTHING * (1 + before)
    if abs(predicted) < tiny and abs(found) < tiny:
        return 1.0
    return found / predicted if predicted > 0 else -1.0


def _sizes(step: Array, covariance: Array) -> float:
    """Return the largest part of a step in its standard deviation."""
    return float((np.abs(step) / np.sqrt(np.diag(covariance))).max(initial=0.0))
