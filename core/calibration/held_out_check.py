"""Residuals of a calibration: on held-out poses, between repeats, and their diagnosis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.converged_fit import FitState
from gapbridge.core.calibration.noise import prior_noise
from gapbridge.core.calibration.observables.position import measured_in_base
from gapbridge.core.calibration.problem import Problem
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.diagnosis.diagnosis import Diagnosis, diagnose
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.linear_system import joint_covariance
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix, rotation_vector

MIN_CHANCE = 1e-3  # p-value below which held-out residuals are inconsistent with the fit
MIN_POSES_TO_DIAGNOSE = 12


@dataclass(frozen=True)
class HeldOutCheck:
    """Test of the held-out residuals against their predicted covariance."""

    ratio: float  # mean square over the predicted one; nan without held-out readings
    chance: float  # p-value of the ratio; 1 without held-out readings
    outliers: NDArray[np.int64]  # rows of held-out readings far beyond the predicted spread

    @property
    def is_consistent(self) -> bool:
        """Return whether the held-out residuals are consistent with the fit."""
        return self.chance > MIN_CHANCE


def check_held_out(
    problem: Problem, state: FitState, calibrated: Model, readings: Readings, metrology: Metrology
) -> HeldOutCheck:
    """Return the test of the held-out readings, with noise and uncertainty of the fit."""
    rows = np.flatnonzero(readings.held_out)
    if not len(rows):
        return HeldOutCheck(float("nan"), 1.0, rows)
    part, observable = readings[rows], problem.observable
    residual = observable.residual(calibrated, part, state.nuisance)
    k = residual.shape[1]
    shape, _ = prior_noise(calibrated, part, observable, state.nuisance, metrology)
    V = replace(shape, sizes=state.noise.sizes).variance + predicted(problem, state, part)
    square = np.einsum("ni,ni->n", residual, np.linalg.solve(V, residual[..., None])[..., 0])
    outliers = square > 30 + 5 * k
    kept = square[~outliers] if (~outliers).sum() >= 3 else square
    ratio = float(kept.sum() / (k * len(kept)))
    chance = float(fisher.sf(ratio, k * len(kept), state.freedom))
    return HeldOutCheck(ratio, chance, rows[outliers])


def predicted(problem: Problem, state: FitState, readings: Readings) -> Array:
    """Return the covariance (N, k, k) of the fit's prediction of readings, without noise."""
    layout = problem.observable.layout(problem.readings)  # these may be of some places only
    arguments = problem.parameters, state.values, readings, state.nuisance, layout
    J, F = problem.observable.columns(*arguments)
    X = np.hstack([J, F]).reshape(len(readings), problem.observable.equations, -1)
    C = joint_covariance(state.system, problem.bounds, problem.readings.repeats())
    return np.asarray(X @ C @ np.swapaxes(X, 1, 2))


def repeatability_of(
    problem: Problem, state: FitState, calibrated: Model, readings: Readings
) -> float:
    """Return the arm's 1 sigma of one coordinate from repeated poses (m); nan without repeats.

    The instrument's noise is subtracted.
    """
    residual = problem.observable.residual(calibrated, readings, state.nuisance)[:, :3]
    outliers = np.zeros(len(readings), dtype=bool)
    outliers[np.flatnonzero(~readings.held_out)[~state.inliers]] = True
    keys = np.column_stack([readings.pose, readings.load, readings.station, readings.target])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    group = group.reshape(-1)
    square, freedom = 0.0, 0
    for one in np.unique(group[~outliers]):
        visits = residual[(group == one) & ~outliers]
        if len(visits) > 1:
            square += float(np.sum((visits - visits.mean(axis=0)) ** 2))
            freedom += visits.shape[1] * (len(visits) - 1)
    if freedom < 3:
        return float("nan")
    return float(np.sqrt(max(square / freedom - state.noise.instrument**2, 0.0)))


def diagnose_residual(
    calibrated: Model, readings: Readings, state: FitState, metrology: Metrology,
    progress: Callable[[str], None],
) -> Diagnosis | None:  # fmt: skip
    """Return the diagnosis of the calibrated model's residual; None where it is not possible.

    Only positions and poses of the first target; places are transformed to base by the fit, and one
    common frame is estimated.
    """
    used = readings.target == 0
    if readings.kind not in ("position", "pose") or used.sum() < MIN_POSES_TO_DIAGNOSE:
        return None
    part = readings[used]
    position = measured_in_base(part, state.nuisance)
    columns = {"actual_q": part.q, "measured_position": position} | _load_columns(part)
    if readings.kind == "pose":
        frames, _ = state.nuisance.frames(part.station)
        rotation = np.swapaxes(frames, 1, 2) @ rotation_matrix(part.value[:, 3:])
        columns["measured_rotation"] = rotation_vector(rotation)
    log = Log("the session's readings", columns, part.q.shape[1])
    progress("diagnosing the residual")
    try:
        return diagnose(calibrated, log, metrology, progress=progress)
    except InputError:
        return None


def _load_columns(readings: Readings) -> dict[str, Array]:
    """Return loads, temperatures and approaches as columns of a log."""
    loads = readings.loads
    columns = {
        "payload": loads.payload_mass, "payload_cog": loads.payload_cog,
        "actual_TCP_force": loads.wrench, "joint_temperatures": loads.temperature,
        "approach": loads.approach,
    }  # fmt: skip
    return {name: value for name, value in columns.items() if value is not None}
