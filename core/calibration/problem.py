"""The regression problem of a calibration, its bounds, weights and cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.noise import Noise, NoisePrior
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.staging import Stages
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.errors import ExcitationError, InputError
from gapbridge.core.estimation.linear_system import Bounds, System
from gapbridge.core.estimation.robust import scale_of, weights_of

PRIOR_SIZES = 10.0  # usual sizes: prior 1 sigma of a parameter about its start


@dataclass(frozen=True)
class Problem:
    """Parameters and the readings that they are fitted to."""

    parameters: Parameters
    observable: Observable
    readings: Readings  # those to fit
    bounds: Bounds
    stages: Stages
    noise_prior: NoisePrior

    def residual(self, values: Array, nuisance: Nuisance) -> Array | None:
        """Return measured minus predicted (N, k), m; None where the arm has no equilibrium."""
        try:
            model = self.parameters.model(values)
            return self.observable.residual(model, self.readings, nuisance)
        except InputError:
            return None

    def prior(self, values: Array) -> float:
        """Return the squared distance of values from their start, in prior sigmas."""
        return float(np.sum(((values - self.bounds.begin) / self.bounds.prior_std) ** 2))


def bounds_of(parameters: Parameters, readings: Readings) -> Bounds:
    """Return the parameters' bounds and priors; the total payload is 0 or more at every reading."""
    prior_std, lower = PRIOR_SIZES * parameters.scales, parameters.lower.copy()
    declared = readings.loads.payload_mass
    nominal = parameters.nominal
    lightest = nominal.payload_mass if declared is None else float(np.min(declared))
    for i, (t, _) in enumerate(parameters.place):
        if CATALOGUE[parameters.terms[t].effect].adds_mass:
            lower[i] = max(lower[i], -max(lightest + nominal.added_mass, 0.0))
    return Bounds(lower, parameters.upper, prior_std, parameters.begin)


def require_enough(parameters: Parameters, observable: Observable, readings: Readings) -> None:
    """Raise ExcitationError where there are fewer equations than unknowns."""
    unknown = len(parameters) + observable.layout(readings).size
    equations = len(readings) * observable.equations
    if equations <= unknown:
        raise ExcitationError(
            f"{len(readings)} reading(s) to fit give {equations} numbers, expected more than the "
            f"{unknown} that are to be found; measure more poses or ask for fewer effects"
        )


def weighted_system(
    residual: Array, noise: Noise, columns: tuple[Array, Array], leverage: Array | None = None
) -> tuple[System, Array]:
    """Return the system of ``residual`` (N, k) divided by the noise, weighted; the weights (N,).

    ``leverage`` (N,) of the readings corrects the residuals of influential ones, which a fit makes
    small.
    """
    N, k = residual.shape
    W = noise.whitener
    J, F = ((W @ c.reshape(N, k, -1)).reshape(N * k, -1) for c in columns)
    e = (W @ residual[..., None])[..., 0]
    numbers = np.full(N, float(k)) if leverage is None else np.maximum(k - leverage, 0.3 * k)
    # far from the solution the residual is larger than the noise: scale by its median
    scale = max(scale_of(e / np.sqrt(numbers / k)[:, None]), 1.0)
    weights = weights_of(np.sqrt(np.sum(e**2, axis=1) / numbers) / scale)
    return System(J, F, e.ravel()).weighted(np.repeat(np.sqrt(weights), k)), weights


def cost(residual: Array, noise: Noise, weights: Array) -> float:
    """Return the weighted sum of squares of ``residual`` (N, k) in units of the noise."""
    e = (noise.whitener @ residual[..., None])[..., 0]
    return float(np.sum(weights * np.sum(e**2, axis=1)))
