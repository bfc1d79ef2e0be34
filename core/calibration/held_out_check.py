"""What a calibration leaves over: on poses that it never saw, between repeats, to the diagnosis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.converged_fit import FitState
from gapbridge.core.calibration.noise import presumed
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

SURPRISE = 1e-3  # chance below which held-out poses are no longer like the fitted ones
FEWEST_TO_DIAGNOSE = 12


@dataclass(frozen=True)
class HeldOutCheck:
    """How poses that the fit never saw agree with its predicted covariance."""

    held_out: int  # readings
    ratio: float  # mean square over the predicted one; nan without held-out readings
    chance: float  # of so large a ratio were all well; 1 without
    outliers: NDArray[np.int64]  # rows of held-out readings far beyond the predicted spread

    @property
    def is_consistent(self) -> bool:
        """Return whether nothing in them speaks against the fit."""
        return self.chance > SURPRISE


def check_held_out(
    problem: Problem, rest: FitState, found: Model, readings: Readings, metrology: Metrology
) -> HeldOutCheck:
    """Return how the held-out readings stand against the fit, noise and uncertainty counted."""
    rows = np.flatnonzero(readings.held_out)
    if not len(rows):
        return HeldOutCheck(0, float("nan"), 1.0, rows)
    part, observable = readings[rows], problem.observable
    residual = observable.residual(found, part, rest.nuisance)
    k = residual.shape[1]
    shape, _ = presumed(found, part, observable, rest.nuisance, metrology)
    V = replace(shape, sizes=rest.noise.sizes).variance + predicted(problem, rest, part)
    square = np.einsum("ni,ni->n", residual, np.linalg.solve(V, residual[..., None])[..., 0])
    outliers = square > 30 + 5 * k
    kept = square[~outliers] if (~outliers).sum() >= 3 else square
    ratio = float(kept.sum() / (k * len(kept)))
    chance = float(fisher.sf(ratio, k * len(kept), rest.freedom))
    return HeldOutCheck(len(rows), ratio, chance, rows[outliers])


def predicted(problem: Problem, rest: FitState, readings: Readings) -> Array:
    """Return the covariance (N, k, k) of what the fit predicts of readings, noise left aside."""
    layout = problem.observable.layout(problem.readings)  # these may be of some places only
    given = problem.parameters, rest.values, readings, rest.nuisance, layout
    J, F = problem.observable.columns(*given)
    X = np.hstack([J, F]).reshape(len(readings), problem.observable.equations, -1)
    C = joint_covariance(rest.system, problem.bounds, problem.readings.repeats())
    return np.asarray(X @ C @ np.swapaxes(X, 1, 2))


def repeatability_of(problem: Problem, rest: FitState, found: Model, readings: Readings) -> float:
    """Return the arm's 1 sigma of one coordinate from repeated poses (m); nan without repeats.

    The instrument's own noise is taken off.
    """
    residual = problem.observable.residual(found, readings, rest.nuisance)[:, :3]
    outliers = np.zeros(len(readings), dtype=bool)
    outliers[np.flatnonzero(~readings.held_out)[~rest.inliers]] = True
    keys = np.column_stack([readings.pose, readings.load, readings.station, readings.target])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    group = group.reshape(-1)
    square, freedom = 0.0, 0
    for one in np.unique(group[~outliers]):
        own = residual[(group == one) & ~outliers]
        if len(own) > 1:
            square += float(np.sum((own - own.mean(axis=0)) ** 2))
            freedom += own.shape[1] * (len(own) - 1)
    if freedom < 3:
        return float("nan")
    return float(np.sqrt(max(square / freedom - rest.noise.instrument**2, 0.0)))


def diagnosed(
    found: Model, readings: Readings, rest: FitState, metrology: Metrology,
    progress: Callable[[str], None],
) -> Diagnosis | None:  # fmt: skip
    """Return the diagnosis of what the calibrated model leaves over, or None where it has no log.

    Positions and poses of the first target alone; all places are brought into base as the fit has
    them, and one common frame stays free.
    """
    use = readings.target == 0
    if readings.kind not in ("position", "pose") or use.sum() < FEWEST_TO_DIAGNOSE:
        return None
    part = readings[use]
    position = measured_in_base(part, rest.nuisance)
    columns = {"actual_q": part.q, "measured_position": position} | _acting(part)
    if readings.kind == "pose":
        frames, _ = rest.nuisance.frames(part.station)
        turned = np.swapaxes(frames, 1, 2) @ rotation_matrix(part.value[:, 3:])
        columns["measured_rotation"] = rotation_vector(turned)
    log = Log("the session's readings", columns, part.q.shape[1])
    progress("diagnosing what is left")
    try:
        return diagnose(found, log, metrology, progress=progress)
    except InputError:
        return None


def _acting(readings: Readings) -> dict[str, Array]:
    """Return what acted on the arm, as a log names it."""
    loads = readings.loads
    given = {
        "payload": loads.payload_mass, "payload_cog": loads.payload_cog,
        "actual_TCP_force": loads.wrench, "joint_temperatures": loads.temperature,
        "approach": loads.approach,
    }  # fmt: skip
    return {name: value for name, value in given.items() if value is not None}
