"""The inputs of an uncertainty budget, from the data of a session."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.calibration.budget.pose_accuracy import KINDS, repeats
from gapbridge.core.calibration.budget.sensitivity import Sensitivities
from gapbridge.core.calibration.result import Calibration

MIN_REPEATS_FREEDOM = 12  # degrees of freedom from which repeats determine the repeatability
OUTLIER_FACTOR = 8.0  # times the median error, beyond which a held-out reading is an outlier
MAX_OUTLIER_SHARE = 0.05  # of the held-out readings


class Basis(Enum):
    """What a standard uncertainty is taken from."""

    COVARIANCE = auto()  # of the fit: number of parameters, of coordinates
    REPEATS = auto()  # poses visited again: their number, that of their readings
    FIT_SCATTER = auto()  # too few repeats: what the fit leaves, without the instrument's share
    HELD_OUT = auto()  # errors beyond the inputs before: coordinates looked at, outlier rows
    FITTED = auto()  # the same where no pose was held out


@dataclass(frozen=True)
class Input:
    """One input of the budget: from readings (type A), of normal distribution, sensitivity 1."""

    basis: Basis
    std: float  # m, standard uncertainty
    freedom: float  # degrees of freedom
    values: tuple[Any, ...] = ()  # the numbers that its basis names


def outlier_readings(calibration: Calibration) -> NDArray[np.int64]:
    """Return the rows of outliers, which a budget excludes.

    Those that the fit down-weighted, and single held-out ones far beyond all others.
    """
    held = calibration.held_out_after
    median = float(np.median(held.norm)) if len(held.rows) else 0.0
    far = held.rows[held.norm > OUTLIER_FACTOR * median]
    if len(far) > max(1, MAX_OUTLIER_SHARE * len(held.rows)):
        far = far[:0]  # too many for outliers: the model is wrong there
    return np.unique(np.concatenate([calibration.outliers, far])).astype(np.int64)


def reading_noise(calibration: Calibration) -> float:
    """Return 1 sigma of one coordinate of an averaged reading, m: the instrument alone."""
    if np.isfinite(calibration.instrument_noise):
        return calibration.instrument_noise
    scatter = calibration.readings.scatter
    known = scatter[np.isfinite(scatter)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else 0.0


def parameters_of_model(calibration: Calibration, sensitivity: Sensitivities | None) -> Input:
    """Return the uncertainty of all parameters together, with their correlations."""
    std = sensitivity.combined if sensitivity else 0.0
    if len(calibration.tcp_std):
        std = float(np.sqrt(np.mean(calibration.tcp_std**2) / 3))
    counts = len(calibration.covariance), calibration.after.vector.size
    return Input(Basis.COVARIANCE, std, _fit_freedom(calibration), counts)


def repeatability_of_arm(calibration: Calibration, reading: float) -> Input:
    """Return the repeatability of the arm, without the noise of the instrument."""
    groups = repeats(calibration.readings)
    freedom = sum(3 * (len(g) - 1) for g in groups)
    if np.isfinite(calibration.repeatability) and freedom >= MIN_REPEATS_FREEDOM:
        counts = len(groups), sum(len(g) for g in groups)
        return Input(Basis.REPEATS, calibration.repeatability, float(freedom), counts)
    std = float(np.sqrt(max(calibration.noise**2 - reading**2, 0.0)))
    return Input(Basis.FIT_SCATTER, std, _fit_freedom(calibration))


def _fit_freedom(calibration: Calibration) -> float:
    if np.isfinite(calibration.freedom):
        return max(calibration.freedom, 1.0)
    spent = len(calibration.covariance) + 6 * len(calibration.stations)
    return float(max(calibration.after.vector.size - spent, 1))


def model_residual(calibration: Calibration, parameters: float, noise: float) -> Input:
    """Return the error of the held-out poses in excess of parameters, arm and instrument."""
    held_out = len(calibration.held_out_after.vector) > 0
    chosen = calibration.held_out_after if held_out else calibration.after
    outliers = np.intersect1d(outlier_readings(calibration), chosen.rows)
    errors = chosen.vector[~np.isin(chosen.rows, outliers)]
    # of readings that are not positions the parameters' share is unknown: none is subtracted
    share = parameters if held_out and calibration.readings.kind in KINDS else 0.0
    excess = float(np.mean(errors**2)) - noise**2 - share**2
    std, rows = float(np.sqrt(max(excess, 0.0))), tuple(int(r) for r in outliers)
    basis = Basis.HELD_OUT if held_out else Basis.FITTED
    return Input(basis, std, float(errors.size), (errors.size, rows))
