"""The uncertainty of one coordinate of the TCP after a calibration (GUM, JCGM 100:2008).

The measurand is the distance, along one axis of the base, between the place where the calibrated
model puts the TCP and the place where it is. Standard uncertainties combine in squares with their
sensitivities (5.1.2); correlated parameters of the model go in together, as one input, through
their covariance (5.2); degrees of freedom combine by Welch and Satterthwaite (G.4.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import bdtr, stdtr, stdtrit

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.budget.inputs import (
    Input,
    model_remainder,
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
RARE = 0.01  # a chance below which the held-out poses speak against the budget
LENGTH_95 = 2.796  # length of a 3D normal vector that 95 % stay below, in sigmas of a coordinate


@dataclass(frozen=True)
class Budget:
    """A whole budget, for one coordinate."""

    inputs: tuple[Input, ...]
    combined: float  # m
    freedom: float  # effective degrees of freedom
    parameters: Sensitivities | None  # what stands behind the first input, parameter by parameter
    inside: int  # of the held-out coordinates looked at, those whose error is within the bound
    looked_at: int  # 0: none were held out, or they do not show the TCP's place
    bound: float  # m: k times combined uncertainty and measurement of one reading

    @property
    def expanded(self) -> float:
        """Return the expanded uncertainty, k = 2, m."""
        return COVERAGE * self.combined

    @property
    def coverage(self) -> float:
        """Return the share of cases that k = 2 holds, by Student's distribution."""
        freedom = self.freedom if np.isfinite(self.freedom) else 1e9
        return float(1 - 2 * stdtr(freedom, -COVERAGE))

    @property
    def needed_factor(self) -> float:
        """Return the factor that 95.45 % ask for, by Student's distribution."""
        if not np.isfinite(self.freedom):
            return COVERAGE
        return float(stdtrit(self.freedom, 0.5 + PROBABILITY / 2))

    @property
    def doubtful(self) -> bool:
        """Return whether fewer held-out coordinates are inside the bound than chance allows."""
        if not self.looked_at:
            return False
        # errors of one pose go together: they count as one look in three
        looks, found = self.looked_at / 3, self.inside / 3
        return bool(bdtr(np.floor(found), round(looks), self.coverage) < RARE)

    @property
    def expanded_length(self) -> float:
        """Return the distance from its place that the TCP keeps to in 95 % of all poses, m."""
        return LENGTH_95 * self.combined


def budget(calibration: Calibration) -> Budget:
    """Return the budget of a calibration."""
    reading = reading_noise(calibration)
    repeatability = repeatability_of_arm(calibration, reading)
    behind = sensitivities(calibration)
    parameters = parameters_of_model(calibration, behind)
    scatter = float(np.hypot(repeatability.std, reading))
    remainder = model_remainder(calibration, parameters.std, scatter)
    inputs = (parameters, repeatability, remainder)
    combined = float(np.sqrt(sum(i.std**2 for i in inputs)))
    bound = COVERAGE * float(np.hypot(combined, reading))
    errors = _looked_at(calibration)
    return Budget(
        inputs, combined, _effective(inputs, combined), behind, int((errors <= bound).sum()),
        len(errors), bound,
    )  # fmt: skip


def _looked_at(calibration: Calibration) -> Array:
    """Return the sizes of the held-out coordinates that check the budget (M,), m.

    None for readings that do not show the TCP's place: their errors are of something else.
    """
    held = calibration.held_out_after
    if calibration.readings.kind not in KINDS:
        return np.zeros(0)
    return np.abs(held.vector[~np.isin(held.rows, outlier_readings(calibration))]).ravel()


def _effective(inputs: tuple[Input, ...], combined: float) -> float:
    weight = sum(i.std**4 / i.freedom for i in inputs)
    return float(combined**4 / weight) if weight > 0 else float("inf")
