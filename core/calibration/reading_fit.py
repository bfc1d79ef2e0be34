"""Model and instrument fitted to a session's readings so far, to check the next one.

The prior of every parameter is the cell's model with its usual size: few readings suffice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.observables.predicted_readings import concatenated
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.estimation.linear_system import Bounds, System, columns_and_covariance
from gapbridge.core.estimation.robust import start_weights_of
from gapbridge.core.model import Model

FALSE_ALARM = 1e-5  # probability of questioning a good reading
PRIOR_SIZES = 3.0  # usual sizes: prior 1 sigma of the parameters
ROUNDS = 3
HALF_WEIGHT_AT = 4.0  # residual over noise with weight one half: inliers keep nearly all weight
STEP = 1e-5  # rad
NEWTON_STEPS = 6
PRIOR_FREEDOM = 12.0  # degrees of freedom of the prior of the noise


@dataclass(frozen=True)
class ReadingFit:
    """Parameters and instrument, fitted to the readings so far."""

    model: Model
    observable: Observable
    nuisance: Nuisance
    covariance: Array  # (k, k) m2, covariance of the reading that is judged minus its prediction

    def gap(self, new: Readings) -> Array:
        """Return measured minus expected (k,), m, of one reading."""
        new = at_single_place(new)
        return np.asarray(self.observable.residual(self.model, new, self.nuisance)[0])

    def compare(self, new: Readings) -> tuple[float, float, bool]:
        """Return a reading's error and its limit (m), and whether the reading is an outlier."""
        gap = self.gap(new)
        distance = float(gap @ np.linalg.solve(self.covariance, gap))
        limit = float(chdtri(len(gap), FALSE_ALARM))
        off = float(np.linalg.norm(gap[:3]))
        allowed = float(np.sqrt(limit * np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))
        return off, allowed, distance > limit

    def fits(self, new: Readings) -> bool:
        """Return whether one reading is an inlier."""
        return not self.compare(new)[2]

    def single_coordinates(self, new: Readings) -> list[tuple[int, float]]:
        """Return each coordinate (from 0) that alone explains one reading, and its value (m)."""
        if new.value.shape[1] < 3:
            return []
        expected = self.observable.predict(self.model, at_single_place(new), self.nuisance)[0]
        found = []
        for i in range(3):
            value = new.value.copy()
            value[0, i] = expected[i]
            if self.fits(replace(new, value=value)):
                found.append((i, float(expected[i])))
        return found

    def single_joints(self, new: Readings) -> list[tuple[int, float]]:
        """Return each joint (from 0) that alone explains one reading, and its angle (rad)."""
        found = []
        for i in range(new.q.shape[1]):
            q = new.q.copy()
            for _ in range(NEWTON_STEPS):
                gap = self.gap(replace(new, q=q))
                turned = q.copy()
                turned[0, i] += STEP
                slope = (self.gap(replace(new, q=turned)) - gap) / STEP
                q[0, i] -= float(slope @ gap) / max(float(slope @ slope), 1e-12)
            if self.fits(replace(new, q=q)):
                found.append((i, float(q[0, i])))
        return found


def at_single_place(readings: Readings) -> Readings:
    """Return readings as if there were one place of the instrument, and one target."""
    zero = np.zeros(len(readings), dtype=np.int64)
    return replace(readings, station=zero, target=zero)


def fit_readings(
    before: Readings, new: Readings, parameters: Parameters, observable: Observable, sigma: float
) -> ReadingFit:
    """Return the fit to the readings ``before``, outliers down-weighted, to judge ``new`` (one).

    All are of one place and one target; ``sigma`` (m) is the expected noise of one coordinate.
    Derivatives by the parameters are taken once, at the nominal model: all are small. Raises
    ExcitationError where the readings do not show where the instrument stands.
    """
    p, k, count = len(parameters), observable.equations, len(before)
    values = np.zeros(p)
    bounds = Bounds(
        np.full(p, -np.inf), np.full(p, np.inf), PRIOR_SIZES * parameters.scales, values
    )
    has_nuisance = count > 0 and observable.layout(before).size > 0
    nuisance = observable.start(parameters.nominal, before) if has_nuisance else Nuisance.zero()
    both = concatenated(before, new)
    layout = observable.layout(both)
    J, F_new = observable.columns(parameters, values, both, nuisance)
    covariance = np.diag(np.concatenate([bounds.prior_std**2, np.zeros(layout.size)]))
    for _ in range(ROUNDS if count else 0):
        poses = parameters.model(values).predict(before.q, before.loads)
        gap = observable.gap(poses, before, nuisance)
        noise = observable.sigmas * sigma
        weights = start_weights_of(np.linalg.norm(gap / noise, axis=1), HALF_WEIGHT_AT)
        F = observable.nuisance_columns(poses, before, nuisance)
        system = System(J[: count * k], F, gap.ravel())
        system = system.weighted((np.sqrt(weights)[:, None] / noise).ravel())
        A, covariance = columns_and_covariance(system, bounds)
        gradient = A.T @ system.residual
        gradient[:p] -= values / bounds.prior_std**2
        step = covariance @ gradient
        values, nuisance = values + step[:p], nuisance.moved(step[p:], layout)
        sigma *= _noise_factor(system.residual - A @ step, A, covariance)
    last = np.hstack([J[-k:], F_new[-k:]])
    covariance = last @ covariance @ last.T + np.diag((sigma * observable.sigmas) ** 2)
    return ReadingFit(parameters.model(values), observable, nuisance, covariance)


def _noise_factor(residual: Array, A: Array, covariance: Array) -> float:
    """Return the estimated over the expected noise, near 1 with few readings."""
    freedom = len(residual) - float(np.einsum("ij,jk,ik->", A, covariance, A))
    square = (float(residual @ residual) + PRIOR_FREEDOM) / (max(freedom, 0.0) + PRIOR_FREEDOM)
    return float(np.clip(np.sqrt(square), 0.5, 2.0))
