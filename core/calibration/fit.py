"""The fit of a whole session, and its evaluation on the held-out poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.converged_fit import FitState, converged_fit
from gapbridge.core.calibration.held_out_check import (
    check_held_out,
    diagnose_residual,
    repeatability_of,
)
from gapbridge.core.calibration.missing_effects import MissingEffect, missing_effects
from gapbridge.core.calibration.noise import Noise
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Expectation
from gapbridge.core.calibration.problem import Problem
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.result import Calibration, Errors, Estimate
from gapbridge.core.calibration.staging import hausman_chance
from gapbridge.core.calibration.summary import combinations, notes_of, remaining_of
from gapbridge.core.diagnosis.channel_diagnosis import Verdict
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.errors import ExcitationError
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason

Progress = Callable[[str], None]
IDENTIFIABLE = 1.0  # usual sizes: a parameter with a larger std counts as not identifiable


@dataclass(frozen=True)
class SessionFit:
    """A converged fit, not yet evaluated on the held-out readings."""

    parameters: Parameters
    observable: Observable
    metrology: Metrology
    readings: Readings  # all, with those held out
    problem: Problem
    state: FitState
    notes: tuple[Note, ...]
    missing: tuple[MissingEffect, ...]  # further effects that the fitted poses support

    def estimates(self, expected: Expectation | None = None) -> tuple[Estimate, ...]:
        """Return the parameters, with the std that a plan ``expected``."""
        return make_estimates(self.parameters, self.state, expected)


def fit_session(
    readings: Readings,
    parameters: Parameters,
    metrology: Metrology | None = None,
    *,
    observable: Observable | None = None,
    progress: Progress = lambda text: None,
) -> SessionFit:
    """Return the fit of a session's readings, those held out not used.

    Choose the parameters by fits like this one; ``evaluate_fit`` then uses the held-out readings.
    Raises ExcitationError where the readings are too few, InputError where they do not fit the arm.
    """
    metrology = metrology or Metrology()
    observable = observable or make_observable(readings.kind, registered=metrology.registered)
    if readings.held_out.all():
        raise ExcitationError("found no readings to fit: all are held out, expected others")
    readings, notes = _with_determined_places(readings, observable)
    to_fit = np.flatnonzero(~readings.held_out)
    with threadpool_limits(1, "blas"):  # matrices of this size gain nothing from threads
        problem, state = converged_fit(
            parameters, observable, readings[to_fit], metrology, progress
        )
        missing = missing_effects(problem, state)
    return SessionFit(parameters, observable, metrology, readings, problem, state, notes, missing)


def evaluate_fit(
    model: Model,
    fit: SessionFit,
    *,
    declined: tuple[str, ...] = (),
    expected: Expectation | None = None,
    diagnose: bool = True,
    progress: Progress = lambda text: None,
) -> Calibration:
    """Return the calibration, with the errors of the held-out readings: call it once per session.

    ``model`` is the cell's model; ``declined`` are further effects that were fitted and not
    supported by the data.
    """
    parameters, readings = fit.parameters, fit.readings
    problem, state, observable = fit.problem, fit.state, fit.observable
    to_fit = np.flatnonzero(~readings.held_out)
    missing = tuple(e for e in fit.missing if e.name not in declined)
    with threadpool_limits(1, "blas"):
        progress("checking held-out poses")
        calibrated = parameters.model(state.values)
        check = check_held_out(problem, state, calibrated, readings, fit.metrology)
        diagnosis = None
        if diagnose:
            diagnosis = diagnose_residual(calibrated, readings, state, fit.metrology, progress)
    estimates = fit.estimates(expected)
    shown = np.array([e.shown for e in estimates], dtype=bool)
    errors = _errors(model, calibrated, observable, readings, state.nuisance)
    hausman = hausman_chance(
        state.system, problem.stages, state.covariance, problem.bounds, observable.equations,
        np.sqrt(state.weights),
    )  # fmt: skip
    complete = state.converged and check.is_consistent and not missing
    complete = complete and (diagnosis is None or diagnosis.verdict is Verdict.NO_GAP)
    remaining = remaining_of(check, diagnosis, complete, missing, state.converged)
    notes = (*fit.notes, *notes_of(problem, state, check, hausman, estimates))
    return Calibration(
        model=calibrated, readings=readings, estimates=estimates,
        covariance=state.covariance[np.ix_(shown, shown)],
        combinations=(*parameters.redundant, *combinations(parameters, state, shown)),
        before=errors[0], after=errors[1],
        held_out_before=errors[2], held_out_after=errors[3],
        outliers=to_fit[~state.inliers], noise=state.noise.coordinate(),
        repeatability=repeatability_of(problem, state, calibrated, readings),
        stations=state.nuisance.stations,
        tcp_std=tcp_deviation(parameters, state, readings[readings.held_out]),
        diagnosis=diagnosis, complete=complete,
        remaining=remaining, notes=notes,
        instrument_noise=state.noise.instrument, joint_noise=state.noise.joint,
        turn_noise=_rotation_noise(observable, state.noise), freedom=state.freedom,
        whole_covariance=state.covariance, missing_effects=tuple(effect.name for effect in missing),
        noise_floor=_floor(diagnosis),
    )  # fmt: skip


def _floor(diagnosis: Diagnosis | None) -> float:
    """Return the noise floor of the measured positions (m); nan where it is unknown."""
    channels = () if diagnosis is None else diagnosis.channels
    floors = [c.noise_floor_rms for c in channels if c.channel == "position"]
    return float("nan") if not floors or floors[0] is None else float(floors[0])


def _with_determined_places(
    readings: Readings, observable: Observable
) -> tuple[Readings, tuple[Note, ...]]:
    """Return the readings, with held-out ones fitted where a place or target has too few others."""
    layout = observable.layout(readings)
    unknown = len(layout.frame) + int(layout.length)
    # one reading more than the equations require: two positions do not determine a frame
    enough = unknown // observable.equations + 1 if unknown else 1
    held_out, fitted = readings.held_out, ~readings.held_out
    alone = np.zeros(len(readings), dtype=bool)
    for place, least in ((readings.station, enough), (readings.target, 1)):
        for one in np.unique(place):  # poses, not readings: repeats add no point
            if len(np.unique(readings.pose[fitted & (place == one)])) < least:
                alone |= held_out & (place == one)
    if not alone.any():
        return readings, ()
    note = Note(Reason.VERIFYING_FITTED, (int(alone.sum()),))
    return replace(readings, held_out=held_out & ~alone), (note,)


def make_estimates(
    parameters: Parameters, state: FitState, expected: Expectation | None
) -> tuple[Estimate, ...]:
    """Return the parameters as they are reported, with the std that the plan ``expected``."""
    planned_stds = {} if expected is None else dict(
        zip(expected.names, expected.std, strict=True)
    )  # fmt: skip
    std = np.sqrt(np.diag(state.covariance))
    estimates = []
    for i, name in enumerate(parameters.names):
        planned_std = planned_stds.get(name)
        estimates.append(
            Estimate(
                name, float(state.values[i]), float(std[i]), parameters.units[i],
                None if planned_std is None else float(planned_std),
                shown=bool(std[i] < IDENTIFIABLE * parameters.scales[i]),
                on_bound=bool(state.on_bound[i]), freedom=state.freedom,
            )
        )  # fmt: skip
    return tuple(estimates)


def _errors(
    model: Model, calibrated: Model, observable: Observable, readings: Readings, nuisance: Nuisance
) -> tuple[Errors, Errors, Errors, Errors]:
    """Return errors before and after over the fitted poses, then over the held-out ones.

    The errors before are with the instrument's place fitted to the nominal model.
    """
    fitted, held_out = np.flatnonzero(~readings.held_out), np.flatnonzero(readings.held_out)
    nominal_nuisance = observable.start(model, readings[fitted])
    errors = []
    for rows in (fitted, held_out):
        for one, place in ((model, nominal_nuisance), (calibrated, nuisance)):
            gap = np.zeros((0, min(observable.equations, 3)))
            if len(rows):
                gap = observable.residual(one, readings[rows], place)[:, :3]
            errors.append(Errors(gap, rows))
    return errors[0], errors[1], errors[2], errors[3]


def _rotation_noise(observable: Observable, noise: Noise) -> float:
    """Return 1 sigma of a measured rotation (rad); nan where none is measured."""
    if len(noise.sizes) < 3:
        return float("nan")
    return float(noise.sizes[1] * observable.sigmas[3])


def tcp_deviation(parameters: Parameters, state: FitState, readings: Readings) -> Array:
    """Return 1 sigma (3D, m) of the predicted TCP at readings (M,): the parameters' part alone."""
    if not len(readings):
        return np.zeros(0)
    J = parameters.tcp_jacobian(state.values, readings.q, readings.loads)
    return np.asarray(np.sqrt(np.einsum("nki,ij,nkj->n", J, state.covariance, J)))
