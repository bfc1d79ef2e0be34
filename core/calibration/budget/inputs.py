"""The inputs of an uncertainty budget: what a session and its papers say of each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.calibration.budget.pose_accuracy import KINDS, repeats
from gapbridge.core.calibration.budget.sensitivity import Sensitivities
from gapbridge.core.calibration.result import Calibration

ALUMINIUM = 23e-6  # 1/K; steel grows half as much
ENOUGH = 12  # degrees of freedom from which repeats alone determine the arm's scatter
FAR = 8.0  # times the median error: a held-out reading beyond is a blunder
FEW = 0.05  # share of the held-out readings that may be blunders


@dataclass(frozen=True)
class Stated:
    """What people, data sheets and certificates say (type B); None: nobody has said it."""

    error: float | None = None  # m, largest permissible error of the instrument, where it measured
    temperature_range: float | None = None  # K, of the air during the session
    payload_error: float | None = None  # kg, largest error of the loads' declared mass


@dataclass(frozen=True)
class Input:
    """One input of the budget."""

    name: str
    kind: str  # "A": from readings of this session; "B": from anything else
    distribution: str  # "normal" or "rectangular"
    std: float  # standard uncertainty, in ``unit``
    unit: str
    sensitivity: float  # m per ``unit``
    freedom: float  # degrees of freedom; inf: taken as known
    source: str  # where the figure is from, in words

    @property
    def contribution(self) -> float:
        """Return what it makes of the result's standard uncertainty, m."""
        return abs(self.sensitivity) * self.std


def outlier_readings(calibration: Calibration) -> NDArray[np.int64]:
    """Return the rows of readings that no budget can speak for: blunders, not uncertainty.

    Those that the fit down-weighted, and single held-out ones far beyond all others.
    """
    held = calibration.held_out_after
    usual = float(np.median(held.norm)) if len(held.rows) else 0.0
    far = held.rows[held.norm > FAR * usual]
    if len(far) > max(1, FEW * len(held.rows)):
        far = far[:0]  # so many are no blunders: the model is wrong there
    return np.unique(np.concatenate([calibration.outliers, far])).astype(np.int64)


def reading_noise(calibration: Calibration) -> float:
    """Return 1 sigma of one coordinate of an averaged reading, m: the instrument alone."""
    if np.isfinite(calibration.instrument_noise):
        return calibration.instrument_noise
    scatter = calibration.readings.scatter
    known = scatter[np.isfinite(scatter)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else 0.0


def parameters_of_model(calibration: Calibration, behind: Sensitivities | None) -> Input:
    """Return what the fit leaves unsure, all parameters together with their correlations."""
    std = behind.combined if behind else 0.0
    if len(calibration.tcp_std):
        std = float(np.sqrt(np.mean(calibration.tcp_std**2) / 3))
    rows, count = calibration.after.vector.size, len(calibration.covariance)
    return Input(
        "parameters of the model", "A", "normal", std, "m", 1.0, _fit_freedom(calibration),
        f"covariance of {count} parameters from {rows} coordinates, carried to the tool",
    )  # fmt: skip


def repeatability_of_arm(calibration: Calibration, reading: float) -> Input:
    """Return the scatter of the arm, without the part of the instrument."""
    groups = repeats(calibration.readings)
    name, freedom = "repeatability of the arm", sum(3 * (len(g) - 1) for g in groups)
    if np.isfinite(calibration.repeatability) and freedom >= ENOUGH:
        return Input(
            name, "A", "normal", calibration.repeatability, "m", 1.0, float(freedom),
            f"poses visited again: {len(groups)}, with {sum(len(g) for g in groups)} readings",
        )  # fmt: skip
    std = float(np.sqrt(max(calibration.noise**2 - reading**2, 0.0)))
    return Input(
        name, "A", "normal", std, "m", 1.0, _fit_freedom(calibration),
        "too few repeats: scatter of the fit without the instrument's share",
    )  # fmt: skip


def _fit_freedom(calibration: Calibration) -> float:
    if np.isfinite(calibration.freedom):
        return max(calibration.freedom, 1.0)
    spent = len(calibration.covariance) + 6 * len(calibration.stations)
    return float(max(calibration.after.vector.size - spent, 1))


def model_remainder(calibration: Calibration, parameters: float, noise: float) -> Input:
    """Return what the held-out poses show beyond parameters, arm and instrument."""
    held_out = len(calibration.held_out_after.vector) > 0
    chosen = calibration.held_out_after if held_out else calibration.after
    outliers = np.intersect1d(outlier_readings(calibration), chosen.rows)
    errors = chosen.vector[~np.isin(chosen.rows, outliers)]
    # of readings that show no place the parameters' share is not known: none is taken off
    share = parameters if held_out and calibration.readings.kind in KINDS else 0.0
    excess = float(np.mean(errors**2)) - noise**2 - share**2
    std = float(np.sqrt(max(excess, 0.0)))
    where = "held-out poses" if held_out else "fitted poses (none were held out)"
    if len(outliers):
        rows = ", ".join(str(int(r) + 1) for r in outliers)
        where += f", without outliers (reading {rows})"
    found = "nothing found beyond the lines above" if std == 0 else "what is beyond the lines above"
    return Input(
        "what the model does not explain", "A", "normal", std, "m", 1.0, float(errors.size),
        f"{errors.size} coordinates of the {where}: {found}",
    )  # fmt: skip


def instrument_error(stated: Stated) -> Input | None:
    """Return what the instrument's certificate allows, counted whole; None where unstated."""
    if stated.error is None:
        return None
    return Input(
        "error of the instrument", "B", "rectangular", stated.error / np.sqrt(3), "m", 1.0, np.inf,
        "largest permissible error at the distance measured, divided by √3",
    )  # fmt: skip


def temperature_growth(calibration: Calibration, stated: Stated) -> Input | None:
    """Return what the arm grew by during the session; None where unstated."""
    if stated.temperature_range is None:
        return None
    readings = calibration.readings
    tip = calibration.model.predict(readings.q, readings.loads).position
    reach = float(np.sqrt(np.mean(tip**2)))
    return Input(
        "growth with temperature", "B", "rectangular", stated.temperature_range / 2 / np.sqrt(3),
        "K", ALUMINIUM * reach, np.inf,
        "half the range of the air during the session, divided by √3; aluminium, 23 ppm/K",
    )  # fmt: skip


def payload_mass(calibration: Calibration, stated: Stated) -> Input | None:
    """Return what a load of another mass would do; None where unstated."""
    if stated.payload_error is None:
        return None
    return Input(
        "mass of the load", "B", "rectangular", stated.payload_error / np.sqrt(3), "kg",
        _payload_sensitivity(calibration), np.inf, "largest error stated, divided by √3",
    )  # fmt: skip


def _payload_sensitivity(calibration: Calibration) -> float:
    """Return rms over poses and axes of d TCP / d payload mass, m/kg."""
    readings = calibration.readings
    model, step = calibration.model, 0.1
    mass = readings.loads.payload_mass
    mass = np.full(len(readings), model.payload_mass) if mass is None else mass
    more = replace(readings.loads, payload_mass=mass + step)
    change = model.predict(readings.q, more).position
    change = change - model.predict(readings.q, replace(more, payload_mass=mass)).position
    return float(np.sqrt(np.mean(change**2))) / step
