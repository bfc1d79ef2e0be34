"""What the sections of a calibration's report are made of."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gapbridge.bridge.calibration.report.facts import SessionFacts
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.budget.budget import Budget, budget
from gapbridge.core.calibration.budget.inputs import outlier_readings
from gapbridge.core.calibration.budget.pose_accuracy import KINDS, PoseAccuracy, pose_accuracies
from gapbridge.core.calibration.plan import Plan
from gapbridge.core.calibration.result import Calibration, Errors

ERRORS = {
    "position": "the distance between where the tool was measured and where the model puts it",
    "distance": "the difference between the distance that was measured and the model's",
    "sphere": "how far from the sphere the model puts the tool while it touched it",
    "point": "how far from the fixed point the model puts the tip while it was there",
    "relative": "the difference between one ball's place seen from the other, and the model's",
}


@dataclass(frozen=True)
class Material:
    """A calibration with its plan and the facts of its session."""

    calibration: Calibration
    plan: Plan | None
    session: SessionFacts

    @cached_property
    def judged(self) -> tuple[Errors, Errors]:
        """Return the errors before and after by which the calibration is judged.

        Those of the held-out poses; of the fitted ones where none were held out.
        """
        c = self.calibration
        if len(c.held_out_before.vector):
            return c.held_out_before, c.held_out_after
        return c.before, c.after

    @cached_property
    def both(self) -> tuple[Errors, Errors]:
        """Return the errors before and after of all readings, fitted and held out."""
        c = self.calibration
        return _joined(c.before, c.held_out_before), _joined(c.after, c.held_out_after)

    @cached_property
    def inliers(self) -> tuple[Errors, Errors]:
        """Return the errors before and after of all readings but the outliers."""
        before, after = self.both
        kept = np.array([int(r) not in self.outlier_rows for r in before.rows], dtype=bool)
        return (
            Errors(before.vector[kept], before.rows[kept]),
            Errors(after.vector[kept], after.rows[kept]),
        )

    @cached_property
    def accuracies(self) -> tuple[PoseAccuracy, ...]:
        """Return AP and RP of the poses that were visited more than once."""
        return pose_accuracies(self.calibration)

    @cached_property
    def outlier_rows(self) -> frozenset[int]:
        """Return the rows of readings that are blunders."""
        return frozenset(int(r) for r in outlier_readings(self.calibration))

    @property
    def predicted_std(self) -> float:
        """Return 1 sigma (3D, rms) of the predicted TCP at the poses that judge it, m."""
        std = self.calibration.tcp_std
        return float(np.sqrt(np.mean(std**2))) if len(std) else float("nan")

    @property
    def held_out(self) -> bool:
        """Return whether poses were kept out of the fit."""
        return bool(len(self.calibration.held_out_before.vector))

    @property
    def judged_on(self) -> str:
        """Return which poses the errors are judged on."""
        if self.held_out:
            return "poses that the fit never saw"
        return "the poses of the fit themselves (none were kept out)"

    @cached_property
    def budget(self) -> Budget:
        """Return the uncertainty budget."""
        return budget(self.calibration)

    @cached_property
    def tip(self) -> Array:
        """Return where the calibrated model puts the TCP of every reading (N, 3), m, in base."""
        readings = self.calibration.readings
        return self.calibration.model.predict(readings.q, readings.loads).position

    @property
    def shows_places(self) -> bool:
        """Return whether the readings show where the tool is, all three coordinates."""
        return self.calibration.readings.kind in KINDS

    @property
    def error_meaning(self) -> str:
        """Return what an error is, for this kind of reading."""
        return ERRORS.get(self.calibration.readings.kind, ERRORS["position"])

    @property
    def axes(self) -> tuple[str, ...]:
        """Return what the coordinates of an error are called."""
        width = self.judged[0].vector.shape[1]
        return ("x", "y", "z") if width == 3 else ("distance",) if width == 1 else ()


def _joined(first: Errors, second: Errors) -> Errors:
    if not len(second.vector):
        return first
    return Errors(
        np.concatenate([first.vector, second.vector]), np.concatenate([first.rows, second.rows])
    )
