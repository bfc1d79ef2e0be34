"""The nonlinear fit of a calibration: stages first, then all parameters, then the noise as well.

Levenberg-Marquardt with columns scaled to unit length (Marquardt, J. SIAM 11 (1963) 431), since
products of parameters (payload times flexibility) make full Gauss-Newton steps overshoot. Each step
is tried against the exact prediction, and accepted by its gain ratio: actual over predicted
decrease.
The Jacobian is recomputed after a poor ratio or a large move.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.calibration.noise import Noise, estimate_noise, prior_noise
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

NOISE_ROUNDS = 6  # noise estimates at most
NOISE_CONVERGED = 0.02  # relative change of the noise
Columns = tuple[Array, Array]
MAX_LINEARISATIONS = 20
MAX_STEPS = 12  # with the same Jacobian
STEP_CONVERGED = 0.02  # step size over standard deviation
STEP_ACCEPTED = 0.2  # the same after MAX_STEPS, where the weights still change
MAX_DRIFT = 3.0  # standard deviations from the linearisation point beyond which J is recomputed
MIN_GAIN_RATIO = 0.1  # of an accepted step
POOR_RATIO = 0.5  # below it the damping grows and J is recomputed
GOOD_RATIO = 0.8  # above it the damping is reduced
MIN_DAMPING, MAX_DAMPING = 1e-4, 1e8  # less counts as zero; more ends the search
DAMPING_FACTOR = 8.0
ROUNDING = 1e-6  # share of the sum of squares (in variances) that counts as rounding


@dataclass(frozen=True)
class FitState:
    """State of the iteration, with the linearised system there."""

    values: Array  # (p,)
    nuisance: Nuisance
    noise: Noise
    columns: Columns  # J (N*k, p) and F (N*k, m)
    anchor: Array  # (p,) linearisation point
    system: System  # divided by the noise, weighted
    weights: Array  # (N,) 0 outlier, 1 inlier
    on_bound: Mask  # (p,) on a bound
    covariance: Array  # (p, p)
    fitted_numbers: float  # effective number of fitted parameters
    leverage: Array  # (N,) share of each reading in it
    converged: bool  # False: the limit of iterations came first

    @property
    def freedom(self) -> float:
        """Return the residual degrees of freedom."""
        width = len(self.system.residual) / max(len(self.weights), 1)
        return max(float(self.weights.sum()) * width - self.fitted_numbers, 1.0)

    @property
    def inliers(self) -> Mask:
        """Return which readings have a weight above zero (N,)."""
        return np.asarray(self.weights > 0)

    def stale(self) -> bool:
        """Return whether the linearisation point is too far away."""
        return bool(_largest_step(self.values - self.anchor, self.covariance) > MAX_DRIFT)


def converged_fit(
    parameters: Parameters,
    observable: Observable,
    readings: Readings,
    metrology: Metrology,
    progress: Callable[[str], None],
) -> tuple[Problem, FitState]:
    """Return the fit of all parameters to the readings.

    Raises ExcitationError where there are fewer equations than unknowns, InputError where the arm
    has no equilibrium at the start.
    """
    require_enough(parameters, observable, readings)
    bounds, stages = bounds_of(parameters, readings), stages_of(parameters, readings)
    values = parameters.begin.copy()
    begin = parameters.model(values)
    nuisance = observable.start(begin, readings)
    noise, noise_prior = prior_noise(begin, readings, observable, nuisance, metrology)
    problem = Problem(parameters, observable, readings, bounds, stages, noise_prior)
    progress("fitting, look 1")
    state = _after_stages(problem, fit_state(problem, values, nuisance, noise))
    state = converge(problem, state, noise)
    for look in range(NOISE_ROUNDS):  # noise by the residuals of a converged fit
        progress(f"fitting, look {look + 2}")
        before, state = state.noise, converge(problem, state, _updated_noise(problem, state))
        if np.abs(state.noise.sizes / before.sizes - 1).max() < NOISE_CONVERGED:
            break
    covariance = joint_covariance(state.system, bounds, readings.repeats())
    p = len(parameters)
    return problem, replace(state, covariance=covariance[:p, :p])


def _after_stages(problem: Problem, state: FitState) -> FitState:
    """Return the state after the stages, where they lower the cost."""
    k = problem.observable.equations
    root = np.sqrt(state.weights)
    step = staged_step(state.system, problem.stages, state.values, problem.bounds, k, root)
    values = np.clip(state.values + step, problem.bounds.lower, problem.bounds.upper)
    if problem.residual(values, state.nuisance) is None:
        return state
    poses = problem.parameters.model(values).predict(problem.readings.q, problem.readings.loads)
    nuisance = problem.observable.refined(poses, problem.readings, state.nuisance)
    before = problem.residual(state.values, state.nuisance)
    after = problem.residual(values, nuisance)
    if before is None or after is None:
        return state
    gain = cost(before, state.noise, state.weights) - cost(after, state.noise, state.weights)
    if gain < problem.prior(values) - problem.prior(state.values):
        return state
    return fit_state(problem, values, nuisance, state.noise, state.columns, state.anchor)


def _updated_noise(problem: Problem, state: FitState) -> Noise:
    """Return the noise estimated from the residual."""
    J, F = state.columns
    residual = problem.residual(state.values, state.nuisance)
    assert residual is not None
    offset = state.values - problem.bounds.begin
    precision = np.concatenate([problem.bounds.prior_std**-2.0, np.zeros(F.shape[1])])
    return estimate_noise(
        state.noise, problem.noise_prior, residual + (J @ offset).reshape(residual.shape),
        np.hstack([J, F]), precision, state.inliers,
    )  # fmt: skip


def fit_state(
    problem: Problem, values: Array, nuisance: Nuisance, noise: Noise,
    columns: Columns | None = None, anchor: Array | None = None, leverage: Array | None = None,
) -> FitState:  # fmt: skip
    """Return the state at ``values``, linearised there unless ``columns`` are given.

    Raises InputError where the arm finds no equilibrium.
    """
    residual = problem.residual(values, nuisance)
    if residual is None:
        raise InputError("the arm finds no equilibrium where the fit begins; expected one")
    if columns is None:
        columns = problem.observable.columns(problem.parameters, values, problem.readings, nuisance)
        anchor = values
    system, weights = weighted_system(residual, noise, columns, leverage)
    covariance, fitted_numbers, leverages = posterior(system, problem.bounds)
    leverage = leverages.reshape(residual.shape).sum(axis=1)
    return FitState(
        values, nuisance, noise, columns, values if anchor is None else anchor, system, weights,
        np.zeros(len(values), dtype=bool), covariance, fitted_numbers, leverage, converged=False,
    )  # fmt: skip


def converge(problem: Problem, state: FitState, noise: Noise) -> FitState:
    """Return the converged state for this noise, or the last one within the iteration limits."""
    damping = 0.0
    state = fit_state(
        problem, state.values, state.nuisance, noise, state.columns, state.anchor, state.leverage
    )
    for _ in range(MAX_LINEARISATIONS):
        if state.stale():
            state = fit_state(problem, state.values, state.nuisance, noise, leverage=state.leverage)
        state, damping, renew = _marquardt_steps(problem, state, damping)
        if not renew and ((state.converged and not state.stale()) or damping > MAX_DAMPING):
            break
        if renew:
            state = fit_state(problem, state.values, state.nuisance, noise, leverage=state.leverage)
    return state


def _marquardt_steps(
    problem: Problem, state: FitState, damping: float
) -> tuple[FitState, float, bool]:
    """Return the state after steps with one Jacobian, the damping, and whether to recompute it."""
    layout, bounds = problem.observable.layout(problem.readings), problem.bounds
    free = np.ones(len(state.values), dtype=bool)
    size = np.inf
    for _ in range(MAX_STEPS):
        step, shift, on_bound = solve(state.system, state.values, bounds, free, damping)
        size = _largest_step(step, state.covariance)
        small = size < STEP_CONVERGED
        values, nuisance = state.values + step, state.nuisance.moved(shift, layout)
        ratio = _gain_ratio(problem, state, step, shift, (values, nuisance))
        fresh = bool((state.anchor == state.values).all())
        if ratio < MIN_GAIN_RATIO:
            if not fresh:
                return state, damping, True
            if small and damping == 0.0:
                return replace(state, on_bound=on_bound, converged=True), damping, False
            damping = max(DAMPING_FACTOR * damping, MIN_DAMPING)
            if damping > MAX_DAMPING:
                return state, damping, False
            continue
        state = fit_state(
            problem, values, nuisance, state.noise, state.columns, state.anchor, state.leverage
        )
        state = replace(state, on_bound=on_bound, converged=small and damping == 0.0)
        if state.converged:
            return state, damping, False
        if ratio < POOR_RATIO:
            return state, max(damping * 2, MIN_DAMPING), True
        if ratio > GOOD_RATIO:
            damping = damping / DAMPING_FACTOR if damping > MIN_DAMPING else 0.0
    converged = size < STEP_ACCEPTED and damping == 0.0
    return replace(state, converged=converged), damping, not converged


def _gain_ratio(
    problem: Problem, state: FitState, step: Array, shift: Array, trial: tuple[Array, Nuisance]
) -> float:
    """Return the actual over the predicted decrease of a step; 1 where none is predicted."""
    before = float(state.system.residual @ state.system.residual) + problem.prior(state.values)
    remaining = state.system.residual - state.system.J @ step - state.system.F @ shift
    predicted = before - float(remaining @ remaining) - problem.prior(trial[0])
    residual = problem.residual(*trial)
    if residual is None:
        return -1.0
    actual = before - cost(residual, state.noise, state.weights) - problem.prior(trial[0])
    tiny = ROUNDING * (1 + before)
    if abs(predicted) < tiny and abs(actual) < tiny:
        return 1.0
    return actual / predicted if predicted > 0 else -1.0


def _largest_step(step: Array, covariance: Array) -> float:
    """Return the largest element of a step over its standard deviation."""
    return float((np.abs(step) / np.sqrt(np.diag(covariance))).max(initial=0.0))
