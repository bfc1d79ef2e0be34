"""The figures of a demo run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gapbridge.bridge.demo.hidden import HiddenEffects, NamedCause
from gapbridge.bridge.demo.measurements import Measurements
from gapbridge.bridge.demo.poses import TEST_LOADS, Load
from gapbridge.core.arrays import Array
from gapbridge.core.compensation import correct
from gapbridge.core.effects import settling
from gapbridge.core.estimation.identification import Identification
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model


@dataclass(frozen=True)
class LoopFigures:
    """Timing of the daemon's loop."""

    rate: float  # Hz
    missed: int  # cycles of the controller that were missed
    cycles: int
    p99: float  # us, age of the state behind a setpoint, in the worst run


@dataclass(frozen=True)
class Resolution:
    """Resolution of a link at the TCP, m: what one count of its protocol comes to."""

    written: float  # of an offset, or of a joint setpoint times the reach
    read: float  # of the joints as read, times the reach
    note: str = ""  # what that means for the result


@dataclass(frozen=True)
class Result:
    """The result of the whole demo."""

    link: str
    seed: int
    identification: Identification
    model: Model  # calibrated
    uncompensated: Measurements  # test visits, setpoints of the rigid arm
    compensated: Measurements  # the same visits, corrected setpoints
    loads: tuple[str, ...]  # name of the load of each visit
    setpoints_written: int
    loop: LoopFigures
    duration: float  # s
    resolution: Resolution = Resolution(0.0, 0.0)
    test_loads: tuple[Load, ...] = TEST_LOADS
    explained: Measurements | None = None  # the same visits, the named causes corrected too
    hidden: HiddenEffects | None = None  # true effects besides the flexibilities
    corrected: Model | None = None  # with the causes that the diagnosis named
    causes: tuple[NamedCause, ...] = ()  # named by the diagnosis after the fit

    @property
    def error_without(self) -> Array:
        """Return the distance (M,), m, of the TCP from its intended position, uncompensated."""
        return tcp_error(self.model, self.uncompensated)

    @property
    def error_fitted(self) -> Array:
        """Return the same, corrected by the fitted flexibilities alone."""
        return tcp_error(self.model, self.compensated)

    @property
    def error_with(self) -> Array:
        """Return the same, corrected by fit and diagnosis."""
        return tcp_error(self.model, self.explained or self.compensated)

    @property
    def joint_errors(self) -> tuple[Array, Array] | None:
        """Return the joint errors at rest (M, n), rad, without and with compensation.

        None where no servo yields. Their reference corrects the arm's effects, not the servos'.
        """
        servos = () if self.corrected is None else settling(self.corrected.terms)
        if self.corrected is None or self.explained is None or not servos:
            return None
        others = tuple(t for t in self.corrected.terms if t not in servos)
        run = self.explained
        loads = Loads(run.payload, run.payload_cog, run.force)
        intended = correct(replace(self.corrected, terms=others), run.nominal_q, loads).q
        before = self.uncompensated.actual_q - self.uncompensated.nominal_q
        return before, run.actual_q - intended

    @property
    def rounds(self) -> tuple[tuple[str, Array], ...]:
        """Return name and errors (M,), m, of each round of visits."""
        if self.explained is None:
            return (("without", self.error_without), ("with compensation", self.error_with))
        return (
            ("without", self.error_without), ("fit alone", self.error_fitted),
            ("fit and diagnosis", self.error_with),
        )  # fmt: skip

    @property
    def repeatability(self) -> float:
        """Return the rms distance (m) between visits of one pose and their mean."""
        return repeatability([self.uncompensated, self.compensated], self.loads)

    def summary(self) -> dict[str, Any]:
        """Return what summary.json holds."""
        return {
            "link": self.link,
            "seed": self.seed,
            "samples": self.identification.samples,
            "tcp_error_mm": {
                "without": millimetres(self.error_without),
                "fitted": millimetres(self.error_fitted),
                "with": millimetres(self.error_with),
            },
            "hidden": None if self.hidden is None else dict(self.hidden.truth),
            "accused": {
                name: {"value": value, "std": std, "unit": unit}
                for cause in self.causes
                for name, value, std, unit in cause.parameters
            },
            "joint_error_mrad": self._joint_figures(),
            "repeatability_mm": self.repeatability * 1e3,
            "resolution_mm": self.resolution.written * 1e3,
            "reading_resolution_mm": self.resolution.read * 1e3,
            "setpoints_written": self.setpoints_written,
            "loop": {
                "rate_hz": self.loop.rate,
                "missed": self.loop.missed,
                "cycles": self.loop.cycles,
                "p99_us": self.loop.p99,
            },
            "duration_s": self.duration,
        }

    def _joint_figures(self) -> dict[str, dict[str, float]] | None:
        errors = self.joint_errors
        if errors is None:
            return None
        return {k: millimetres(np.abs(e)) for k, e in zip(("without", "with"), errors, strict=True)}


def tcp_error(model: Model, measurements: Measurements) -> Array:
    """Return the distance (M,), m, of the measured TCP from the rigid arm's at the nominal pose."""
    intended = model.rigid_pose(measurements.nominal_q).position
    return np.asarray(np.linalg.norm(measurements.position - intended, axis=1))


def repeatability(runs: list[Measurements], labels: tuple[str, ...]) -> float:
    """Return the rms distance (m) of visits from the mean of all visits to the same pose.

    Per run, pose and load; each mean takes one degree of freedom. NaN without repeated visits.
    """
    square, freedom = 0.0, 0
    for run in runs:
        keys = [(label, *q) for label, q in zip(labels, run.nominal_q.tolist(), strict=True)]
        for key in set(keys):
            rows = run.position[[i for i, k in enumerate(keys) if k == key]]
            square += float(np.sum((rows - rows.mean(axis=0)) ** 2))
            freedom += len(rows) - 1
    return float(np.sqrt(square / freedom)) if freedom else float("nan")


def millimetres(error: Array) -> dict[str, float]:
    """Return rms and largest of distances (m) in mm, or of angles (rad) in mrad."""
    return {"rms": float(np.sqrt(np.mean(error**2))) * 1e3, "max": float(error.max()) * 1e3}


def visits_of_poses(result: Result) -> list[list[int]]:
    """Return the row numbers of each pose and load, in the order of the first visit."""
    rows: dict[tuple[object, ...], list[int]] = {}
    for i, (load, q) in enumerate(
        zip(result.loads, np.round(result.uncompensated.nominal_q, 9).tolist(), strict=True)
    ):
        rows.setdefault((load, *q), []).append(i)
    return list(rows.values())
