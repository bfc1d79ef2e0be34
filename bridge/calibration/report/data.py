"""The data of a session's report: its facts, and the errors that the sections share."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path

import numpy as np

from gapbridge.bridge.document.blocks import DOUBTFUL, GOOD, Badge
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.budget.budget import Budget, budget
from gapbridge.core.calibration.budget.inputs import outlier_readings
from gapbridge.core.calibration.budget.pose_accuracy import KINDS, PoseAccuracy, pose_accuracies
from gapbridge.core.calibration.plan import Plan
from gapbridge.core.calibration.result import Calibration, Errors

ERROR_DEFINITIONS = {
    "position": "the distance between the measured and the predicted position of the tool",
    "distance": "the difference between the measured and the predicted distance",
    "sphere": "the predicted distance of the tool from the sphere that it touched",
    "point": "the predicted distance of the tip from the fixed point that it touched",
    "relative": "the difference between the measured and the predicted vector between the balls",
}


@dataclass(frozen=True)
class InstrumentFacts:
    """The instrument by its data sheet, its certificate and the operator."""

    name: str
    kind: str = "position"  # key of core.calibration.observables.OBSERVABLES
    serial: str = ""
    certificate: str = ""  # number or date of its own calibration
    sigma: float = 2.0e-5  # m, 1 sigma of one coordinate of a single reading, as declared
    distance: float = 0.0  # m, usual distance from the instrument to the target


@dataclass(frozen=True)
class SessionFacts:
    """One session; the report omits empty fields."""

    cell: str  # name of the cell
    arm: str
    instrument: InstrumentFacts
    folder: Path  # of the session
    started: datetime
    ended: datetime
    readings: int  # accepted ones
    undone: int = 0  # discarded by the operator
    serial: str = ""  # of the arm
    operator: str = ""
    customer: str = ""
    environment: str = ""  # temperature, place, ...
    number: str = ""  # of the report
    version: str = ""  # of Gapbridge
    cell_sha256: str = ""  # of the cell file that was calibrated
    accuracy: float | None = None  # m, required; None: no requirement
    remarks: tuple[str, ...] = ()  # notes and irregularities


@dataclass(frozen=True)
class CalibrationData:
    """A calibration with its plan and the facts of its session."""

    calibration: Calibration
    plan: Plan | None
    session: SessionFacts

    @cached_property
    def validation_errors(self) -> tuple[Errors, Errors]:
        """Return the errors before and after of the held-out poses; without any, of the fitted."""
        c = self.calibration
        if len(c.held_out_before.vector):
            return c.held_out_before, c.held_out_after
        return c.before, c.after

    @cached_property
    def all_errors(self) -> tuple[Errors, Errors]:
        """Return the errors before and after of all readings, fitted and held out."""
        c = self.calibration
        return _joined(c.before, c.held_out_before), _joined(c.after, c.held_out_after)

    @cached_property
    def inlier_errors(self) -> tuple[Errors, Errors]:
        """Return the errors before and after of all readings except outliers."""
        before, after = self.all_errors
        kept = np.array([int(r) not in self.outlier_rows for r in before.rows], dtype=bool)
        return (
            Errors(before.vector[kept], before.rows[kept]),
            Errors(after.vector[kept], after.rows[kept]),
        )

    @cached_property
    def pose_accuracies(self) -> tuple[PoseAccuracy, ...]:
        """Return AP and RP (ISO 9283) of the poses that were visited more than once."""
        return pose_accuracies(self.calibration)

    @cached_property
    def outlier_rows(self) -> frozenset[int]:
        """Return the rows of outlier readings."""
        return frozenset(int(r) for r in outlier_readings(self.calibration))

    @property
    def predicted_std(self) -> float:
        """Return 1 sigma (3D, rms) of the predicted TCP at the validation poses, m."""
        std = self.calibration.tcp_std
        return float(np.sqrt(np.mean(std**2))) if len(std) else float("nan")

    @property
    def has_held_out(self) -> bool:
        """Return whether any poses were held out."""
        return bool(len(self.calibration.held_out_before.vector))

    @property
    def validation_poses(self) -> str:
        """Return the name of the poses of ``validation_errors``."""
        if self.has_held_out:
            return "poses not used in the fit"
        return "the fitted poses (none were held out)"

    @property
    def completeness(self) -> Badge:
        """Return whether the residual is explained by arm and instrument alone."""
        complete = self.calibration.complete
        return Badge("Complete", GOOD) if complete else Badge("Not complete", DOUBTFUL)

    @cached_property
    def budget(self) -> Budget:
        """Return the uncertainty budget."""
        return budget(self.calibration)

    @cached_property
    def tcp(self) -> Array:
        """Return the TCP of every reading by the calibrated model (N, 3), m, in base."""
        readings = self.calibration.readings
        return self.calibration.model.predict(readings.q, readings.loads).position

    @property
    def measures_position(self) -> bool:
        """Return whether the readings contain all three coordinates of the target."""
        return self.calibration.readings.kind in KINDS

    @property
    def error_definition(self) -> str:
        """Return the definition of an error for this kind of reading."""
        return ERROR_DEFINITIONS.get(self.calibration.readings.kind, ERROR_DEFINITIONS["position"])

    @property
    def axes(self) -> tuple[str, ...]:
        """Return the names of the coordinates of an error."""
        width = self.validation_errors[0].vector.shape[1]
        return ("x", "y", "z") if width == 3 else ("distance",) if width == 1 else ()


def _joined(first: Errors, second: Errors) -> Errors:
    if not len(second.vector):
        return first
    return Errors(
        np.concatenate([first.vector, second.vector]), np.concatenate([first.rows, second.rows])
    )
