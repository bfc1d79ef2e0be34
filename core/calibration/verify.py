"""Does a calibration still hold? A few poses, measured again months later.

What the readings leave over is held against what the calibration predicted: its parameters'
uncertainty, the noise of instrument and arm. Where that is broken, the simple things that may have
moved since compete: the tool, one joint's zero, the load, the instrument, one bad reading.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2
from scipy.stats import f as fisher

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.accuracy_baseline import AccuracyBaseline, baseline_in
from gapbridge.core.calibration.noise import presumed
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

BROKEN = 1e-3  # chance below which a model has moved since its calibration
STEPS = 5  # of Gauss-Newton: a zero that moved by a tooth is no small change
BESIDE = 6.0  # of chi-square: suspects that explain as much are reported beside the best one


@dataclass(frozen=True)
class Suspect:
    """One thing that may have moved."""

    name: str  # tool_frame, joint_offset_3, payload, instrument, reading_4
    estimates: tuple[Estimate, ...]  # how far it moved; none for a bad reading
    chance: float  # of what is left, were it the only change
    chi_square: float  # that it leaves
    effect: str = ""  # none: the instrument, or a reading
    joint: int | None = None  # from 1, of the effect
    reading: int | None = None  # from 1


@dataclass(frozen=True)
class Verification:
    """Whether a calibration still holds."""

    holds: bool
    errors: Errors  # of each reading, the instrument's place fitted where nobody registered it
    predicted: Array  # (M,) m, 1 sigma (3D) that the calibration predicted of each error
    ratio: float  # rms of the errors over what was predicted, the numbers fitted counted
    chance: float  # of so large a ratio if the calibration holds
    moved: Suspect | None  # what explains the change, where one thing does
    suspects: tuple[Suspect, ...]  # others that explain it as well
    stations: tuple[Registration, ...]
    notes: tuple[Note, ...]


@dataclass(frozen=True)
class _Task:
    """Readings against a baseline, whitened by the covariance stated there."""

    residual: Array  # (M,)
    root: Array  # (M, M): root @ equations are independent, of variance one
    F: Array  # (M, m) of the nuisances

    def chi_square(self, columns: Array) -> tuple[float, int, Array, Array]:
        """Return chi-square left, degrees of freedom, the columns' values and covariance."""
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
    where there are too few readings to say anything, InputError where it does not fit the model.
    """
    metrology = metrology or Metrology()
    baseline = (
        calibration if isinstance(calibration, AccuracyBaseline) else baseline_in(calibration)
    )
    how = observable or make_observable(readings.kind, registered=metrology.registered)
    parameters = baseline.parameters(model)
    nuisance = how.start(model, readings)
    residual = how.residual(model, readings, nuisance)
    if residual.size <= how.layout(readings).size + 1:
        raise ExcitationError(
            f"verification: {len(readings)} reading(s) only determine where the instrument stands, "
            "expected more poses"
        )
    task, spread = _task(model, how, readings, nuisance, baseline, parameters, metrology)
    rest, freedom, _, _ = task.chi_square(np.zeros((residual.size, 0)))
    ratio = float(np.sqrt(rest / freedom))
    chance = float(fisher.sf(rest / freedom, freedom, baseline.freedom))
    holds = chance > BROKEN
    suspects = () if holds else _suspects(model, how, readings, nuisance, task)
    if suspects and suspects[0].chance <= BROKEN:  # far from where the model was, perhaps
        suspects = _suspects(model, how, readings, nuisance, task, STEPS)
    moved = suspects[0] if suspects and suspects[0].chance > BROKEN else None
    errors = Errors(residual[:, :3], np.arange(len(readings)))
    return Verification(
        holds, errors, spread, ratio, chance, moved,
        tuple(s for s in suspects[1:] if moved and s.chi_square < moved.chi_square + BESIDE),
        nuisance.stations, _notes(baseline, metrology, freedom),
    )  # fmt: skip


def _task(
    model: Model, how: Observable, readings: Readings, nuisance: Nuisance,
    baseline: AccuracyBaseline, parameters: Parameters, metrology: Metrology,
) -> tuple[_Task, Array]:  # fmt: skip
    """Return the whitened problem, and what was predicted of each error (N,)."""
    at = np.zeros(len(parameters))
    J, F = how.columns(parameters, at, readings, nuisance)
    noise, _ = presumed(model, readings, how, nuisance, metrology)
    sizes = [_instrument(baseline, metrology)]
    if len(noise.sizes) > 2:
        turn = baseline.turn / how.sigmas[3]
        sizes.append(turn if np.isfinite(turn) else noise.sizes[1])
    sizes.append(baseline.joint if np.isfinite(baseline.joint) else noise.joint)
    own = np.asarray(sum(s**2 * one for s, one in zip(sizes, noise.shapes, strict=True)))
    N, k, _ = own.shape
    V = J @ baseline.covariance @ J.T
    for i in range(N):
        V[i * k : i * k + k, i * k : i * k + k] += own[i]
    spread = np.sqrt(np.diag(V).reshape(N, k)[:, :3].sum(axis=1))
    root = np.linalg.inv(np.linalg.cholesky(V))
    return _Task(how.residual(model, readings, nuisance).ravel(), root, F), spread


def _instrument(baseline: AccuracyBaseline, metrology: Metrology) -> float:
    """Return 1 sigma of today's instrument: what the session found where it is the same one."""
    same = abs(baseline.sigma - metrology.sigma) < 1e-3 * metrology.sigma
    known = np.isfinite(baseline.instrument) and (same or not np.isfinite(baseline.sigma))
    return baseline.instrument if known else metrology.sigma


def _suspects(
    model: Model, how: Observable, readings: Readings, nuisance: Nuisance, task: _Task,
    steps: int = 1,
) -> tuple[Suspect, ...]:  # fmt: skip
    """Return what may have moved, the most likely first: by what it leaves and what it costs.

    ``steps``: of Gauss-Newton, for each of them.
    """
    found = []
    for effect, joint in _stories(model, readings):
        name = effect if joint is None else f"{effect}_{joint}"
        own = Parameters.every(model, (name,))
        at, where, there = np.zeros(len(own)), nuisance, task
        for step in range(steps):
            if step:
                moved = own.model(at)
                where = how.start(moved, readings)
                there = replace(task, residual=how.residual(moved, readings, where).ravel())
            J, F = how.columns(own, at, readings, where)
            there = replace(there, F=F)
            at = at + there.chi_square(J)[2]
        suspect, freedom = _suspect(name, there, J, own.names, own.units, at)
        found.append((replace(suspect, effect=effect, joint=joint), freedom))
    if how.registered and how.frame:
        free = make_observable(readings.kind)
        F = free.nuisance_columns(model.predict(readings.q, readings.loads), readings, nuisance)
        names = [f"instrument_{k}" for k in ("x", "y", "z", "rx", "ry", "rz")][: F.shape[1]]
        found.append(_suspect("instrument", task, F, names, ("m",) * 3 + ("rad",) * 3))
    N, k = len(readings), len(task.residual) // len(readings)
    for i in range(N):
        columns = np.zeros((N * k, k))
        columns[i * k : i * k + k] = np.eye(k)
        suspect, freedom = _suspect(f"reading_{i + 1}", task, columns, (), ())
        found.append((replace(suspect, reading=i + 1), freedom))
    costs = np.log(len(task.residual))
    return tuple(sorted((s for s, _ in found), key=lambda s: s.chi_square + costs * _cost(s, k)))


def _stories(model: Model, readings: Readings) -> list[tuple[str, int | None]]:
    """Return effects, and joints, that may have changed since."""
    mass = readings.loads.payload_mass
    loaded = model.payload_mass > 0 if mass is None else bool((mass > 0).any())
    return [
        (identifier, site.joint)
        for identifier, effect in CATALOGUE.items()
        if effect.moved and (loaded or not effect.adds_mass)
        for site in effect.sites(model.arm)
    ]


def _cost(suspect: Suspect, width: int) -> int:
    return len(suspect.estimates) or width


def _suspect(
    name: str, task: _Task, columns: Array, names: tuple[str, ...] | list[str],
    units: tuple[str, ...], found: Array | None = None,
) -> tuple[Suspect, int]:  # fmt: skip
    """Return a suspect and its degrees of freedom; ``found``: its values after several steps."""
    rest, freedom, values, covariance = task.chi_square(columns)
    values = values if found is None else found
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    # a direction that nothing shows has neither value nor width
    seen = (std > 0) | (np.abs(values) > 0)
    estimates = tuple(
        Estimate(n, float(v), float(s), u)
        for n, v, s, u, shown in zip(names, values, std, units, seen, strict=False)
        if shown
    )
    chance = float(chi2.sf(rest, freedom)) if freedom > 0 else 0.0
    return Suspect(name, estimates, chance, rest), freedom


def _notes(baseline: AccuracyBaseline, metrology: Metrology, freedom: int) -> tuple[Note, ...]:
    notes = []
    if not metrology.registered:
        notes.append(Note(Reason.FRAME_FITTED))
    if freedom < 9:
        notes.append(Note(Reason.FEW_NUMBERS, (freedom,)))
    return tuple(notes)
