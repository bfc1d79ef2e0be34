"""The uncertainty of one coordinate of the TCP after a calibration (GUM, JCGM 100:2008).

The measurand is the error of the calibrated model's TCP along one axis of the base. Standard
uncertainties combine in squares with their sensitivities (5.1.2); the correlated parameters of the
model are one input, by their covariance (5.2); degrees of freedom combine by Welch and
Satterthwaite (G.4.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import bdtr, stdtr, stdtrit

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.budget.inputs import (
    Input,
    model_residual,
    outlier_readings,
    parameters_of_model,
    reading_noise,
    repeatability_of_arm,
)
from gapbridge.core.calibration.budget.pose_accuracy import KINDS
from gapbridge.core.calibration.budget.sensitivity import Sensitivities, sensitivities
from gapbridge.core.calibration.result import Calibration

COVERAGE = 2.0  # k
PROBABILITY = 0.9545  # of a normal distribution within two standard deviations
MIN_CHANCE = 0.01  # p-value below which the held-out errors contradict the budget
LENGTH_95 = 2.796  # length of a 3D normal vector that 95 % stay below, in sigmas of a coordinate


@dataclass(frozen=True)
class Budget:
    """A whole budget, for one coordinate."""

    inputs: tuple[Input, ...]
    combined: float  # m
    freedom: float  # effective degrees of freedom
    parameters: Sensitivities | None  # of the first input, by parameter
    inside: int  # checked held-out coordinates with an error within the bound
    looked_at: int  # checked held-out coordinates; 0: none held out, or not positions of the TCP
    bound: float  # m: k times combined uncertainty and measurement of one reading

    @property
    def expanded(self) -> float:
        """Return the expanded uncertainty, k = 2, m."""
        return COVERAGE * self.combined

    @property
    def coverage(self) -> float:
        """Return the coverage probability of k = 2, by Student's distribution."""
        freedom = self.freedom if np.isfinite(self.freedom) else 1e9
        return float(1 - 2 * stdtr(freedom, -COVERAGE))

    @property
    def needed_factor(self) -> float:
        """Return the coverage factor for 95.45 %, by Student's distribution."""
        if not np.isfinite(self.freedom):
            return COVERAGE
        return float(stdtrit(self.freedom, 0.5 + PROBABILITY / 2))

    @property
    def doubtful(self) -> bool:
        """Return whether fewer held-out coordinates are inside the bound than chance allows."""
        if not self.looked_at:
            return False
        # the three errors of one pose are correlated: they count as one
        looks, found = self.looked_at / 3, self.inside / 3
        return bool(bdtr(np.floor(found), round(looks), self.coverage) < MIN_CHANCE)

    @property
    def expanded_length(self) -> float:
        """Return the 95 % quantile of the TCP's distance from its predicted place, m."""
        return LENGTH_95 * self.combined


def budget(calibration: Calibration) -> Budget:
    """Return the budget of a calibration."""
    reading = reading_noise(calibration)
    repeatability = repeatability_of_arm(calibration, reading)
    sensitivity = sensitivities(calibration)
    parameters = parameters_of_model(calibration, sensitivity)
    scatter = float(np.hypot(repeatability.std, reading))
    model = model_residual(calibration, parameters.std, scatter)
    inputs = (parameters, repeatability, model)
    combined = float(np.sqrt(sum(i.std**2 for i in inputs)))
    bound = COVERAGE * float(np.hypot(combined, reading))
    errors = _checked_errors(calibration)
    return Budget(
        inputs, combined, _effective_freedom(inputs, combined), sensitivity,
        int((errors <= bound).sum()), len(errors), bound,
    )  # fmt: skip


def _checked_errors(calibration: Calibration) -> Array:
    """Return the sizes of the held-out coordinates that check the budget (M,), m.

    None for readings that are not positions of the TCP.
    """
    held = calibration.held_out_after
    if calibration.readings.kind not in KINDS:
        return np.zeros(0)
    return np.abs(held.vector[~np.isin(held.rows, outlier_readings(calibration))]).ravel()


def _effective_freedom(inputs: tuple[Input, ...], combined: float) -> float:
    weight = sum(i.std**4 / i.freedom for i in inputs)
    return float(combined**4 / weight) if weight > 0 else float("inf")
