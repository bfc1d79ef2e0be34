"""Verification of a calibration by a few poses that are measured later.

The residuals are tested against the covariance that the calibration predicted: uncertainty of the
parameters, noise of instrument and arm. If the test fails, single changes are compared: the tool,
the zero of one joint, the load, the instrument, one wrong reading.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2
from scipy.stats import f as fisher

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.accuracy_baseline import AccuracyBaseline, read_baseline
from gapbridge.core.calibration.noise import prior_noise
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.result import Errors, Estimate
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.errors import ExcitationError
from gapbridge.core.estimation.least_squares import (
    DEPENDENT,
    basis_of,
    inverse,
    projected_out,
    solve,
)
from gapbridge.core.estimation.registration import Registration
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason

MIN_CHANCE = 1e-3  # p-value below which the arm counts as changed since its calibration
GAUSS_NEWTON_STEPS = 5  # for large changes, such as a zero that slipped by a tooth of the gear
ALTERNATIVE_MARGIN = 6.0  # of chi-square: changes within it of the best are reported as well


@dataclass(frozen=True)
class CandidateChange:
    """One hypothesis of what has changed, fitted to the readings."""

    name: str  # tool_frame, joint_offset_3, payload, instrument, reading_4
    estimates: tuple[Estimate, ...]  # how far it moved; none for a bad reading
    chance: float  # p-value of the residual if this is the only change
    chi_square: float  # of the residual
    effect: str = ""  # none: the instrument, or a reading
    joint: int | None = None  # from 1, of the effect
    reading: int | None = None  # from 1


@dataclass(frozen=True)
class Verification:
    """Whether a calibration still holds."""

    holds: bool
    errors: Errors  # of each reading, with a fitted place of an instrument that is not registered
    predicted: Array  # (M,) m, 1 sigma (3D) that the calibration predicted of each error
    ratio: float  # rms of the errors over the predicted rms, by degrees of freedom
    chance: float  # p-value of the ratio if the calibration holds
    moved: CandidateChange | None  # the single change that explains the errors, if any
    alternatives: tuple[CandidateChange, ...]  # other changes that explain them as well
    stations: tuple[Registration, ...]
    notes: tuple[Note, ...]

    @property
    def cell_differs(self) -> bool:
        """Return whether the arm may differ from its cell, not only instrument or one reading."""
        changes = () if self.moved is None else (self.moved, *self.alternatives)
        return not self.holds and (not changes or any(change.effect for change in changes))


@dataclass(frozen=True)
class _WhitenedSystem:
    """Residuals and nuisances, whitened by the covariance of a baseline."""

    residual: Array  # (M,)
    root: Array  # (M, M): root @ equations are independent, of variance one
    F: Array  # (M, m) of the nuisances

    def chi_square(self, columns: Array) -> tuple[float, int, Array, Array]:
        """Return residual chi-square, degrees of freedom, the columns' values and covariance."""
        A = self.root @ np.hstack([self.F, columns])
        b = self.root @ self.residual
        basis, m = basis_of(A), self.F.shape[1]
        values, left = solve(A, b, rank=DEPENDENT), projected_out(basis, b)
        freedom = len(b) - basis.shape[1]
        return float(left @ left), freedom, values[m:], inverse(A.T @ A, DEPENDENT**2)[m:, m:]


def verify(
    model: Model,
    readings: Readings,
    calibration: Mapping[str, Any] | AccuracyBaseline,
    metrology: Metrology | None = None,
    *,
    observable: Observable | None = None,
) -> Verification:
    """Return whether the calibration that made ``model`` still holds, and if not, what moved.

    ``calibration`` is its baseline (``accuracy_baseline.document_of``). Raises ExcitationError
    where there are too few readings, InputError where the baseline does not fit the model.
    """
    metrology = metrology or Metrology()
    baseline = (
        calibration if isinstance(calibration, AccuracyBaseline) else read_baseline(calibration)
    )
    observable = observable or make_observable(readings.kind, registered=metrology.registered)
    parameters = baseline.parameters(model)
    nuisance = observable.start(model, readings)
    residual = observable.residual(model, readings, nuisance)
    if residual.size <= observable.layout(readings).size + 1:
        raise ExcitationError(
            f"verification: {len(readings)} reading(s) only determine where the instrument stands, "
            "expected more poses"
        )
    system, spread = _whitened_system(
        model, observable, readings, nuisance, baseline, parameters, metrology
    )
    chi_square, freedom, _, _ = system.chi_square(np.zeros((residual.size, 0)))
    ratio = float(np.sqrt(chi_square / freedom))
    chance = float(fisher.sf(chi_square / freedom, freedom, baseline.freedom))
    holds = chance > MIN_CHANCE
    changes = () if holds else _ranked_changes(model, observable, readings, nuisance, system)
    if changes and changes[0].chance <= MIN_CHANCE:  # perhaps too large a change for one step
        changes = _ranked_changes(model, observable, readings, nuisance, system, GAUSS_NEWTON_STEPS)
    moved = changes[0] if changes and changes[0].chance > MIN_CHANCE else None
    limit = moved.chi_square + ALTERNATIVE_MARGIN if moved else -np.inf
    return Verification(
        holds, Errors(residual[:, :3], np.arange(len(readings))), spread, ratio, chance, moved,
        tuple(change for change in changes[1:] if change.chi_square < limit),
        nuisance.stations, _notes(metrology, freedom),
    )  # fmt: skip


def _whitened_system(
    model: Model, observable: Observable, readings: Readings, nuisance: Nuisance,
    baseline: AccuracyBaseline, parameters: Parameters, metrology: Metrology,
) -> tuple[_WhitenedSystem, Array]:  # fmt: skip
    """Return the whitened system, and the predicted 1 sigma (3D) of each error (N,), m."""
    values = np.zeros(len(parameters))
    J, F = observable.columns(parameters, values, readings, nuisance)
    noise, _ = prior_noise(model, readings, observable, nuisance, metrology)
    sizes = [_instrument_sigma(baseline, metrology)]
    if len(noise.sizes) > 2:
        turn = baseline.turn / observable.sigmas[3]
        sizes.append(turn if np.isfinite(turn) else noise.sizes[1])
    sizes.append(baseline.joint if np.isfinite(baseline.joint) else noise.joint)
    noise_blocks = np.asarray(sum(s**2 * one for s, one in zip(sizes, noise.shapes, strict=True)))
    N, k, _ = noise_blocks.shape
    V = J @ baseline.covariance @ J.T
    for i in range(N):
        V[i * k : i * k + k, i * k : i * k + k] += noise_blocks[i]
    spread = np.sqrt(np.diag(V).reshape(N, k)[:, :3].sum(axis=1))
    root = np.linalg.inv(np.linalg.cholesky(V))
    return _WhitenedSystem(observable.residual(model, readings, nuisance).ravel(), root, F), spread


def _instrument_sigma(baseline: AccuracyBaseline, metrology: Metrology) -> float:
    """Return 1 sigma of the instrument (m): the session's estimate where it is the same one."""
    same = abs(baseline.sigma - metrology.sigma) < 1e-3 * metrology.sigma
    known = np.isfinite(baseline.instrument) and (same or not np.isfinite(baseline.sigma))
    return baseline.instrument if known else metrology.sigma


def _ranked_changes(
    model: Model, observable: Observable, readings: Readings, nuisance: Nuisance,
    system: _WhitenedSystem, steps: int = 1,
) -> tuple[CandidateChange, ...]:  # fmt: skip
    """Return all candidate changes by BIC, after ``steps`` of Gauss-Newton each."""
    changes = []
    for effect, joint in _candidate_changes(model, readings):
        name = effect if joint is None else f"{effect}_{joint}"
        parameters = Parameters.of_effects(model, (name,))
        values, refitted, relinearised = np.zeros(len(parameters)), nuisance, system
        for step in range(steps):
            if step:
                moved = parameters.model(values)
                refitted = observable.start(moved, readings)
                residual = observable.residual(moved, readings, refitted).ravel()
                relinearised = replace(system, residual=residual)
            J, F = observable.columns(parameters, values, readings, refitted)
            relinearised = replace(relinearised, F=F)
            values = values + relinearised.chi_square(J)[2]
        change = _candidate(name, relinearised, J, parameters.names, parameters.units, values)
        changes.append(replace(change, effect=effect, joint=joint))
    if observable.registered and observable.frame:
        free = make_observable(readings.kind)
        F = free.nuisance_columns(model.predict(readings.q, readings.loads), readings, nuisance)
        names = [f"instrument_{k}" for k in ("x", "y", "z", "rx", "ry", "rz")][: F.shape[1]]
        changes.append(_candidate("instrument", system, F, names, ("m",) * 3 + ("rad",) * 3))
    N, k = len(readings), len(system.residual) // len(readings)
    for i in range(N):
        columns = np.zeros((N * k, k))
        columns[i * k : i * k + k] = np.eye(k)
        change = _candidate(f"reading_{i + 1}", system, columns, (), ())
        changes.append(replace(change, reading=i + 1))
    penalty = np.log(len(system.residual))
    return tuple(sorted(changes, key=lambda c: c.chi_square + penalty * (len(c.estimates) or k)))


def _candidate_changes(model: Model, readings: Readings) -> list[tuple[str, int | None]]:
    """Return the effects and joints that may have changed since the calibration."""
    mass = readings.loads.payload_mass
    loaded = model.payload_mass > 0 if mass is None else bool((mass > 0).any())
    return [
        (identifier, site.joint)
        for identifier, effect in CATALOGUE.items()
        if effect.verification_message and (loaded or not effect.adds_mass)
        for site in effect.sites(model.arm)
    ]


def _candidate(
    name: str, system: _WhitenedSystem, columns: Array, names: tuple[str, ...] | list[str],
    units: tuple[str, ...], fitted: Array | None = None,
) -> CandidateChange:  # fmt: skip
    """Return one candidate change; ``fitted``: its values after several steps."""
    chi_square, freedom, values, covariance = system.chi_square(columns)
    values = values if fitted is None else fitted
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    # a direction that is not identifiable has neither value nor variance
    identified = (std > 0) | (np.abs(values) > 0)
    estimates = tuple(
        Estimate(n, float(v), float(s), u)
        for n, v, s, u, identifiable in zip(names, values, std, units, identified, strict=False)
        if identifiable
    )
    chance = float(chi2.sf(chi_square, freedom)) if freedom > 0 else 0.0
    return CandidateChange(name, estimates, chance, chi_square)


def _notes(metrology: Metrology, freedom: int) -> tuple[Note, ...]:
    notes = []
    if not metrology.registered:
        notes.append(Note(Reason.FRAME_FITTED))
    if freedom < 9:
        notes.append(Note(Reason.FEW_NUMBERS, (freedom,)))
    return tuple(notes)
