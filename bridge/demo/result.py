"""What the demo has shown, as numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gapbridge.bridge.demo.hidden import Accused, Hidden
from gapbridge.bridge.demo.poses import TEST_LOADS, Load
from gapbridge.bridge.demo.rests import Rests
from gapbridge.core.arrays import Array
from gapbridge.core.compensation import correct
from gapbridge.core.effects import settling
from gapbridge.core.estimation.identification import Identification
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model


@dataclass(frozen=True)
class LoopFigures:
    """How the daemon's loop kept time."""

    rate: float  # Hz
    missed: int  # cycles of the controller that were not seen
    cycles: int
    p99: float  # us, age of the state behind a setpoint, in the worst run


@dataclass(frozen=True)
class Resolution:
    """What one count on the wire comes to at the TCP, m: the finest that a link can say."""

    written: float  # of an offset, or of a joint setpoint times the reach
    read: float  # of the joints as read, times the reach
    note: str = ""  # what that means for the result


@dataclass(frozen=True)
class Result:
    """The whole demo."""

    link: str
    seed: int
    identification: Identification
    model: Model  # calibrated
    without: Rests  # test visits, effect-free setpoints
    compensated: Rests  # the same visits, corrected setpoints
    loads: tuple[str, ...]  # name of the load of each visit
    setpoints_written: int
    loop: LoopFigures
    duration: float  # s
    resolution: Resolution = Resolution(0.0, 0.0)
    test_loads: tuple[Load, ...] = TEST_LOADS
    explained: Rests | None = None  # the same visits, corrected by what the diagnosis named too
    hidden: Hidden | None = None  # the truth beside the flexibilities
    corrected: Model | None = None  # with what the diagnosis named
    accused: tuple[Accused, ...] = ()  # by the diagnosis, with the fitted flexibilities

    @property
    def error_without(self) -> Array:
        """Return the distance (M,) (m) of the TCP from where it was wanted, uncompensated."""
        return tcp_error(self.model, self.without)

    @property
    def error_fitted(self) -> Array:
        """Return the same, corrected by the fitted flexibilities alone."""
        return tcp_error(self.model, self.compensated)

    @property
    def error_with(self) -> Array:
        """Return the same, corrected by all that was found."""
        return tcp_error(self.model, self.explained or self.compensated)

    @property
    def joint_errors(self) -> tuple[Array, Array] | None:
        """Return how far joints rest from where they are wanted (M, n), rad: before and after.

        None where no servo gives way. Wanted is what corrects the arm behind the servos.
        """
        servos = () if self.corrected is None else settling(self.corrected.terms)
        if self.corrected is None or self.explained is None or not servos:
            return None
        kept = tuple(t for t in self.corrected.terms if t not in servos)
        rests = self.explained
        loads = Loads(rests.payload, rests.payload_cog, rests.force)
        wanted = correct(replace(self.corrected, terms=kept), rests.nominal_q, loads).q
        before = self.without.actual_q - self.without.nominal_q
        return before, rests.actual_q - wanted

    @property
    def series(self) -> tuple[tuple[str, Array], ...]:
        """Return the errors (M,) of each round of visits, by what corrected them."""
        if self.explained is None:
            return (("without", self.error_without), ("with compensation", self.error_with))
        return (
            ("without", self.error_without), ("fit alone", self.error_fitted),
            ("fit and diagnosis", self.error_with),
        )  # fmt: skip

    @property
    def repeatability(self) -> float:
        """Return how far (m, rms) the arm comes back from where it was: measured on revisits."""
        return repeatability([self.without, self.compensated], self.loads)

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
                for cause in self.accused
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


def reach(model: Model) -> float:
    """Return the length of the stretched arm with its tool, m."""
    return model.length


def tcp_error(model: Model, rests: Rests) -> Array:
    """Return the distance (M,) (m) of the measured TCP from the rigid arm's at the meant pose."""
    wanted = model.rigid_pose(rests.nominal_q).position
    return np.asarray(np.linalg.norm(rests.position - wanted, axis=1))


def repeatability(runs: list[Rests], labels: tuple[str, ...]) -> float:
    """Return the rms distance (m) of visits from the mean of all visits to the same pose.

    Within each run, pose and load; corrected for the degree of freedom that each mean takes.
    """
    square, freedom = 0.0, 0
    for rests in runs:
        keys = [(label, *q) for label, q in zip(labels, rests.nominal_q.tolist(), strict=True)]
        for key in set(keys):
            rows = rests.position[[i for i, k in enumerate(keys) if k == key]]
            square += float(np.sum((rows - rows.mean(axis=0)) ** 2))
            freedom += len(rows) - 1
    return float(np.sqrt(square / freedom)) if freedom else float("nan")


def millimetres(error: Array) -> dict[str, float]:
    """Return rms and largest of distances (m) in mm, or of angles (rad) in mrad."""
    return {"rms": float(np.sqrt(np.mean(error**2))) * 1e3, "max": float(error.max()) * 1e3}


def visits_of_poses(result: Result) -> list[list[int]]:
    """Return the rows of each pose and load, in the order of their first visit."""
    found: dict[tuple[object, ...], list[int]] = {}
    for i, (load, q) in enumerate(
        zip(result.loads, np.round(result.without.nominal_q, 9).tolist(), strict=True)
    ):
        found.setdefault((load, *q), []).append(i)
    return list(found.values())
