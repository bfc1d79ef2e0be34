"""Gauss and Newton's steps of a calibration, to the exact prediction, until it comes to rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.calibration.noise import Known, Noise, estimated, presumed
from core.calibration.observables.nuisance import Nuisance
from core.calibration.observables.observable import Observable
from core.calibration.parameters import Parameters
from core.calibration.readings import Readings
from core.calibration.robust import scaled_length, weights_of
from core.calibration.staging import Stages, staged_step, stages_of
from core.calibration.system import Bounds, Mask, System, posterior, solve
from core.errors import ExcitationError, InputError
from core.metrology import Metrology

Array = NDArray[np.float64]
HELD = 10.0  # usual sizes within which a parameter is weakly held at its beginning
NOISES = 2
LOOKS = 4  # derivatives taken anew at most
STEPS = 12  # steps with the same derivatives at most
MOVED = 0.02  # of its deviation: a smaller step changes nothing that anybody reports
STALE = 3.0  # deviations of movement beyond which derivatives are taken anew
WILD = 0.1  # weight below which a reading counts as wild


@dataclass(frozen=True)
class Problem:
    """What is fitted to what."""

    parameters: Parameters
    observable: Observable
    readings: Readings  # those to fit
    bounds: Bounds
    stages: Stages
    known: Known


@dataclass(frozen=True)
class Rest:
    """Where the fit stands."""

    values: Array  # (p,)
    nuisance: Nuisance
    noise: Noise
    weights: Array  # (N,) 0 wild, 1 calm
    stuck: Mask  # (p,) on a bound
    covariance: Array  # (p, p)
    spent: float  # numbers that the fit spent
    system: System  # at rest, divided by the noise, weighed

    @property
    def freedom(self) -> float:
        """Return the degrees of freedom left."""
        width = len(self.system.left) / max(len(self.weights), 1)
        return max(float(self.weights.sum()) * width - self.spent, 1.0)

    @property
    def calm(self) -> Mask:
        """Return which readings count (N,)."""
        return np.asarray(self.weights > WILD)


def bounds_of(parameters: Parameters) -> Bounds:
    """Return the parameters' bounds, and how firmly each is held at its beginning."""
    held = HELD * parameters.scales
    return Bounds(parameters.lower, parameters.upper, held, parameters.begin)


def come_to_rest(
    parameters: Parameters,
    observable: Observable,
    readings: Readings,
    metrology: Metrology,
    progress: Callable[[str], None],
) -> tuple[Problem, Rest]:
    """Return the fit of all parameters to the readings.

    Raises ExcitationError where there are fewer readings than numbers to find, InputError where
    the arm finds no equilibrium with what they ask for.
    """
    _require(parameters, observable, readings)
    bounds, stages = bounds_of(parameters), stages_of(parameters, readings)
    values = parameters.begin.copy()
    begin = parameters.model(values)
    nuisance = observable.start(begin, readings)
    noise, known = presumed(begin, readings, observable, nuisance, metrology)
    problem = Problem(parameters, observable, readings, bounds, stages, known)
    rest: Rest | None = None
    for look in range(LOOKS):
        progress(f"fitting, look {look + 1}")
        J, F = observable.columns(parameters, values, readings, nuisance)
        anchor = values
        if rest is None:
            values, nuisance = _staged(problem, values, nuisance, noise, (J, F))
        for _ in range(NOISES):  # which readings are wild and how large the noise is, in turn
            rest = _stepped(problem, values, nuisance, noise, (J, F))
            values, nuisance = rest.values, rest.nuisance
            if look:
                noise = _noise(problem, rest, (J, F))
        assert rest is not None
        deviation = np.sqrt(np.diag(rest.covariance))
        if look and float((np.abs(values - anchor) / deviation).max(initial=0.0)) < STALE:
            break
    return problem, _stepped(problem, values, nuisance, noise, (J, F))


def _require(parameters: Parameters, observable: Observable, readings: Readings) -> None:
    unknown = len(parameters) + observable.layout(readings).size
    found = len(readings) * observable.equations
    if found <= unknown:
        raise ExcitationError(
            f"{len(readings)} reading(s) to fit give {found} numbers, expected more than the "
            f"{unknown} that are to be found; measure more poses or ask for fewer effects"
        )


def _staged(
    problem: Problem, values: Array, nuisance: Nuisance, noise: Noise, columns: tuple[Array, Array]
) -> tuple[Array, Nuisance]:
    """Return values and nuisance after the stages."""
    system, weights = weighed_system(problem, values, nuisance, noise, columns)
    k = problem.observable.equations
    step = staged_step(system, problem.stages, values, problem.bounds, k, np.sqrt(weights))
    moved = np.clip(values + step, problem.bounds.lower, problem.bounds.upper)
    if not _stands(problem, moved):
        return values, nuisance
    poses = problem.parameters.model(moved).predict(problem.readings.q, problem.readings.loads)
    return moved, problem.observable.settled(poses, problem.readings, nuisance)


def _stands(problem: Problem, values: Array) -> bool:
    """Return whether the arm finds its equilibrium with these values."""
    try:
        problem.parameters.model(values).predict(problem.readings.q, problem.readings.loads)
    except InputError:
        return False
    return True


def weighed_system(
    problem: Problem, values: Array, nuisance: Nuisance, noise: Noise, columns: tuple[Array, Array],
    share: Array | None = None,
) -> tuple[System, Array]:  # fmt: skip
    """Return the system at these values divided by the noise and weighed, and the weights (N,).

    ``share`` (N,) are the numbers that the fit spent on each reading, so that small residuals of
    readings with much influence are not taken for calm.
    """
    model = problem.parameters.model(values)
    left = problem.observable.residual(model, problem.readings, nuisance)
    N, k = left.shape
    W = noise.whitener
    J, F = ((W @ c.reshape(N, k, -1)).reshape(N * k, -1) for c in columns)
    e = (W @ left[..., None])[..., 0]
    cells = np.full(N, float(k)) if share is None else np.maximum(k - share, 0.3 * k)
    square = np.sum(e**2, axis=1)
    # while much is still to be found, what remains is larger than the noise: its middle counts
    usual = max(float(np.median(square / cells)) / _middle(k), 1.0)
    weights = weights_of(scaled_length(square / usual, cells))
    system = System(J, F, e.ravel()).weighed(np.repeat(np.sqrt(weights), k))
    return system, weights


def _middle(k: int) -> float:
    """Return the median of chi-square over its k degrees of freedom."""
    return (1 - 2 / (9 * k)) ** 3


def _stepped(
    problem: Problem, values: Array, nuisance: Nuisance, noise: Noise, columns: tuple[Array, Array]
) -> Rest:
    """Return the rest that steps with the same derivatives lead to."""
    layout = problem.observable.layout(problem.readings)
    free = np.ones(len(values), dtype=bool)
    k = problem.observable.equations
    share: Array | None = None
    system, weights = weighed_system(problem, values, nuisance, noise, columns)
    stuck = ~free
    for _ in range(STEPS):
        covariance, spent, each = posterior(system, problem.bounds)
        share = each.reshape(-1, k).sum(axis=1)
        step, shift, stuck = solve(system, values, problem.bounds, free)
        while not _stands(problem, values + step):
            step, shift = step / 2, shift / 2
        values, nuisance = values + step, nuisance.moved(shift, layout)
        system, weights = weighed_system(problem, values, nuisance, noise, columns, share)
        deviation = np.sqrt(np.diag(covariance))
        if float((np.abs(step) / deviation).max(initial=0.0)) < MOVED:
            break
    covariance, spent, _ = posterior(system, problem.bounds)
    return Rest(values, nuisance, noise, weights, stuck, covariance, spent, system)


def _noise(problem: Problem, rest: Rest, columns: tuple[Array, Array]) -> Noise:
    """Return the noise that what is left over tells."""
    J, F = columns
    model = problem.parameters.model(rest.values)
    left = problem.observable.residual(model, problem.readings, rest.nuisance)
    off = rest.values - problem.bounds.begin
    precision = np.concatenate([problem.bounds.held**-2.0, np.zeros(F.shape[1])])
    return estimated(
        rest.noise, problem.known, left + (J @ off).reshape(left.shape), np.hstack([J, F]),
        precision, rest.calm,
    )  # fmt: skip
