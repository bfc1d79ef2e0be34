"""Simulated sessions of one plan, again and again, each fitted by its own least squares.

Shares no code with the calibration's fit: Gauss-Newton with one Jacobian, taken at the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.readings import Readings

Array = NDArray[np.float64]
ROUNDS = 6
CONVERGED = 1e-3  # usual sizes: the next step would be of second order in this


@dataclass(frozen=True)
class Scatter:
    """What S sessions found."""

    values: Array  # (S, p)
    truth: Array  # (p,)

    @property
    def std(self) -> Array:
        """Return the scatter (p,) of each parameter about its mean."""
        return np.asarray(self.values.std(axis=0, ddof=1))


def usual_truth(parameters: Parameters, seed: int) -> Array:
    """Return values of usual size (p,), flexibilities positive."""
    random = np.random.default_rng(seed)
    truth = parameters.scales * random.normal(0, 0.7, len(parameters))
    soft = parameters.lower > -1e-12  # what may not be negative
    return np.where(soft, parameters.scales * random.uniform(0.3, 2.0, len(parameters)), truth)


def repeated_sessions(
    parameters: Parameters,
    observable: Observable,
    readings: Readings,
    nuisance: Nuisance,
    *,
    sigma: float,
    sessions: int,
    seed: int,
) -> Scatter:
    """Return what repeated sessions of the same fitted poses find, noise drawn anew each time."""
    random = np.random.default_rng(seed)
    readings = readings[np.flatnonzero(~readings.held_out)]
    truth = usual_truth(parameters, seed)
    exact = observable.predict(parameters.model(truth), readings, nuisance)
    noise_of = sigma * observable.sigmas
    J, F = observable.columns(parameters, truth, replace(readings, value=exact), nuisance)
    weight = np.tile(1 / noise_of, len(readings))[:, None]
    size = F.shape[1]
    prior = np.hstack([np.diag(1 / parameters.prior), np.zeros((len(parameters), size))])
    solver = np.linalg.pinv(np.vstack([np.hstack([J, F]) * weight, prior]), rcond=1e-14)
    layout = observable.layout(readings)
    found = np.empty((sessions, len(parameters)))
    real = parameters.model(truth).predict(readings.q, readings.loads)
    for s in range(sessions):
        measured = replace(readings, value=exact + random.normal(0, 1, exact.shape) * noise_of)
        values, place, poses = truth, nuisance, real
        for number in range(ROUNDS):
            if number:
                poses = parameters.model(values).predict(readings.q, readings.loads)
            gap = observable.gap(poses, measured, place)
            held = -values / parameters.prior
            step = solver @ np.concatenate([gap.ravel() * weight[:, 0], held])
            values = values + step[: len(values)]
            place = place.moved(step[len(values) :], layout)
            if np.abs(step[: len(values)] / parameters.scales).max() < CONVERGED:
                break
        found[s] = values
    return Scatter(found, truth)
