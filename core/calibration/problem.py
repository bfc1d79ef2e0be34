"""What a calibration fits to what, and how far given values are from it, in units of the noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.noise import Known, Noise
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.staging import Stages
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.errors import ExcitationError, InputError
from gapbridge.core.estimation.linear_system import Bounds, System
from gapbridge.core.estimation.robust import scale_of, weights_of

HELD = 10.0  # usual sizes within which a parameter is weakly held at its beginning


@dataclass(frozen=True)
class Problem:
    """What is fitted to what."""

    parameters: Parameters
    observable: Observable
    readings: Readings  # those to fit
    bounds: Bounds
    stages: Stages
    known: Known

    def residual(self, values: Array, nuisance: Nuisance) -> Array | None:
        """Return measured minus predicted (N, k), m; None where the arm finds no equilibrium."""
        try:
            model = self.parameters.model(values)
            return self.observable.residual(model, self.readings, nuisance)
        except InputError:
            return None

    def prior(self, values: Array) -> float:
        """Return how far values are from their beginning, as a sum of squares."""
        return float(np.sum(((values - self.bounds.begin) / self.bounds.held) ** 2))


def bounds_of(parameters: Parameters, readings: Readings) -> Bounds:
    """Return the parameters' bounds, and how firmly each is held at its beginning.

    Nothing that hangs on an arm weighs less than nothing: with what is declared, a payload that is
    to be found is 0 or more at every reading.
    """
    held, lower = HELD * parameters.scales, parameters.lower.copy()
    declared = readings.loads.payload_mass
    nominal = parameters.nominal
    lightest = nominal.payload_mass if declared is None else float(np.min(declared))
    had = sum(t.values[0] for t in nominal.terms if CATALOGUE[t.effect].adds_mass)
    for i, (t, _) in enumerate(parameters.place):
        if CATALOGUE[parameters.terms[t].effect].adds_mass:
            lower[i] = max(lower[i], -max(lightest + had, 0.0))
    return Bounds(lower, parameters.upper, held, parameters.begin)


def require_enough(parameters: Parameters, observable: Observable, readings: Readings) -> None:
    """Raise ExcitationError where there are fewer readings than numbers to find."""
    unknown = len(parameters) + observable.layout(readings).size
    found = len(readings) * observable.equations
    if found <= unknown:
        raise ExcitationError(
            f"{len(readings)} reading(s) to fit give {found} numbers, expected more than the "
            f"{unknown} that are to be found; measure more poses or ask for fewer effects"
        )


def weighted_system(
    residual: Array, noise: Noise, columns: tuple[Array, Array], share: Array | None = None
) -> tuple[System, Array]:
    """Return the system of ``residual`` (N, k) divided by the noise, weighted; the weights (N,).

    ``share`` (N,) are the numbers that the fit spent on each reading, so that small residuals of
    readings with much influence are not taken for inliers.
    """
    N, k = residual.shape
    W = noise.whitener
    J, F = ((W @ c.reshape(N, k, -1)).reshape(N * k, -1) for c in columns)
    e = (W @ residual[..., None])[..., 0]
    cells = np.full(N, float(k)) if share is None else np.maximum(k - share, 0.3 * k)
    # while much is still to be found, what remains is larger than the noise: its middle counts
    usual = max(scale_of(e / np.sqrt(cells / k)[:, None]), 1.0)
    weights = weights_of(np.sqrt(np.sum(e**2, axis=1) / cells) / usual)
    return System(J, F, e.ravel()).weighted(np.repeat(np.sqrt(weights), k)), weights


def cost(residual: Array, noise: Noise, weights: Array) -> float:
    """Return the weighed sum of squares of ``residual`` (N, k) in units of the noise."""
    e = (noise.whitener @ residual[..., None])[..., 0]
    return float(np.sum(weights * np.sum(e**2, axis=1)))
