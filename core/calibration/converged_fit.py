"""A calibration converges: staged, then everything together, then the noise along with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.calibration.levenberg_marquardt import FitState, converge, fit_state
from gapbridge.core.calibration.noise import Noise, estimated, presumed
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.problem import Problem, bounds_of, cost, require_enough
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.staging import staged_step, stages_of
from gapbridge.core.estimation.linear_system import System
from gapbridge.core.metrology import Metrology

NOISES = 6  # times at most that the noise is estimated anew
SAME = 0.02  # relative change of the noise that is none


@dataclass(frozen=True)
class ConvergedFit:
    """Where the fit stands."""

    values: Array  # (p,)
    nuisance: Nuisance
    noise: Noise
    weights: Array  # (N,) 0 outlier, 1 inlier
    stuck: Mask  # (p,) on a bound
    covariance: Array  # (p, p)
    spent: float  # numbers that the fit spent
    system: System  # at rest, divided by the noise, weighed
    converged: bool = True  # False: patience ended before the fit converged

    @property
    def freedom(self) -> float:
        """Return the degrees of freedom left."""
        width = len(self.system.residual) / max(len(self.weights), 1)
        return max(float(self.weights.sum()) * width - self.spent, 1.0)

    @property
    def inliers(self) -> Mask:
        """Return which readings count (N,)."""
        return np.asarray(self.weights > 0)


def converged_fit(
    parameters: Parameters,
    observable: Observable,
    readings: Readings,
    metrology: Metrology,
    progress: Callable[[str], None],
) -> tuple[Problem, ConvergedFit]:
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
    at = _staged(problem, fit_state(problem, values, nuisance, noise), noise)
    at = converge(problem, at, noise)
    for look in range(NOISES):  # the noise is determined by what is left once the fit is at rest
        progress(f"fitting, look {look + 2}")
        before, noise = noise, _noise(problem, at, noise)
        at = converge(problem, at, noise)
        if np.abs(noise.sizes / before.sizes - 1).max() < SAME:
            break
    return problem, ConvergedFit(
        at.values, at.nuisance, noise, at.weights, at.stuck, at.covariance, at.spent, at.system,
        at.converged,
    )  # fmt: skip


def _staged(problem: Problem, at: FitState, noise: Noise) -> FitState:
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
    gain = cost(here, noise, at.weights) - cost(there, noise, at.weights)
    if gain < problem.prior(values) - problem.prior(at.values):
        return at
    return fit_state(problem, values, nuisance, noise, at.columns, at.anchor)


def _noise(problem: Problem, at: FitState, noise: Noise) -> Noise:
    """Return the noise that the residual implies."""
    J, F = at.columns
    residual = problem.residual(at.values, at.nuisance)
    assert residual is not None
    off = at.values - problem.bounds.begin
    precision = np.concatenate([problem.bounds.held**-2.0, np.zeros(F.shape[1])])
    return estimated(
        noise, problem.known, residual + (J @ off).reshape(residual.shape), np.hstack([J, F]),
        precision, np.asarray(at.weights > 0),
    )  # fmt: skip
