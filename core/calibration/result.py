"""The result of a calibration: estimates, errors, and what remains."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.estimation.registration import Registration
from gapbridge.core.model import Model
from gapbridge.core.notes import Note


@dataclass(frozen=True)
class Estimate:
    """One parameter, as it is reported; names and signs of docs/conventions.md."""

    name: str
    value: float
    std: float  # 1 sigma
    unit: str
    expected_std: float | None = None  # what the plan predicted
    shown: bool = True  # False: not identifiable from the data; kept at its start
    on_bound: bool = False
    freedom: float = np.inf  # degrees of freedom of ``std``

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval (Student's, for the degrees of freedom behind ``std``)."""
        half = float(stdtrit(self.freedom, 0.975)) * self.std
        return self.value - half, self.value + half


@dataclass(frozen=True)
class Errors:
    """Error of each reading's prediction: vectors (M, k) in base, m; k = 3, or 1 for distances."""

    vector: Array
    rows: NDArray[np.int64]  # (M,) rows of the readings

    @property
    def norm(self) -> Array:
        """Return the length of each (M,), m."""
        return np.asarray(np.linalg.norm(self.vector, axis=1))

    @property
    def rms(self) -> float:
        """Return the rms of the lengths, m; nan without any."""
        return float(np.sqrt(np.mean(self.norm**2))) if len(self.vector) else float("nan")

    @property
    def mean(self) -> float:
        """Return the mean length, m; nan without any."""
        return float(self.norm.mean()) if len(self.vector) else float("nan")

    @property
    def max(self) -> float:
        """Return the largest length, m; nan without any."""
        return float(self.norm.max()) if len(self.vector) else float("nan")


@dataclass(frozen=True)
class Calibration:
    """A fit of a whole session. Errors before and after are over the same rows."""

    model: Model  # calibrated
    readings: Readings
    estimates: tuple[Estimate, ...]
    covariance: Array  # (p, p) of the estimates that are shown, in their order
    combinations: tuple[Note, ...]  # what cannot be separated
    before: Errors  # fitted poses, nominal model
    after: Errors
    held_out_before: Errors  # held-out poses
    held_out_after: Errors
    outliers: NDArray[np.int64]  # rows of the readings that were down-weighted as outliers
    noise: float  # m, 1 sigma of one coordinate of the residual
    repeatability: float  # m, 1 sigma of one coordinate, from repeated poses; nan: none were
    stations: tuple[Registration, ...]  # frame of each place of the instrument
    tcp_std: Array  # (M,) m, 1 sigma (3D) of the predicted TCP at the held-out poses
    diagnosis: Diagnosis | None  # of the residual; None where the readings do not allow it
    complete: bool  # True: no residual structure that a further effect could explain
    remaining: Note
    notes: tuple[Note, ...] = field(default=())
    instrument_noise: float = float("nan")  # m, 1 sigma of one coordinate, the instrument alone
    turn_noise: float = float("nan")  # rad, 1 sigma of a measured rotation; nan: none were
    joint_noise: float = float("nan")  # rad, 1 sigma of one joint's repeatability
    freedom: float = float("inf")  # residual degrees of freedom
    missing_effects: tuple[str, ...] = ()  # supported by the fitted poses, but not requested
    noise_floor: float = float("nan")  # m, 1 sigma of one coordinate, without the fit; nan: unknown
    whole_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))  # of all estimates
