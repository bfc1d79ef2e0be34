"""The fit of a whole session: staged, then everything together, held-out poses never touched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.converged_fit import FitState, converged_fit
from gapbridge.core.calibration.held_out_check import check_held_out, diagnosed, repeatability_of
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
from gapbridge.core.calibration.staging import at_odds
from gapbridge.core.calibration.summary import combinations, notes_of, remaining_of
from gapbridge.core.diagnosis.channel_diagnosis import Verdict
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.errors import ExcitationError
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason

Progress = Callable[[str], None]
IDENTIFIABLE = 1.0  # usual sizes: a parameter that is known no better counts as not identifiable


@dataclass(frozen=True)
class SessionFit:
    """A converged fit that nobody has judged: the held-out readings have not been looked at."""

    parameters: Parameters
    observable: Observable
    metrology: Metrology
    readings: Readings  # all, those held out too
    problem: Problem
    rest: FitState
    notes: tuple[Note, ...]
    missing: tuple[MissingEffect, ...]  # further effects that the fitted poses support

    def estimates(self, expected: Expectation | None = None) -> tuple[Estimate, ...]:
        """Return the parameters, beside what a plan ``expected`` of them."""
        return estimates_of(self.parameters, self.rest, expected)


def fit_session(
    readings: Readings,
    parameters: Parameters,
    metrology: Metrology | None = None,
    *,
    observable: Observable | None = None,
    progress: Progress | None = None,
) -> SessionFit:
    """Return the fit of a session's readings, without a look at those held out.

    What to fit is chosen on fits like this one; ``judged`` then looks at the held-out readings.
    Raises ExcitationError where the readings are too few, InputError where they do not fit the arm.
    """
    metrology = metrology or Metrology()
    how = observable or make_observable(readings.kind, registered=metrology.registered)
    if readings.held_out.all():
        raise ExcitationError("found no readings to fit: all are held out, expected others")
    readings, lonely = _with_places(readings, how)
    to_fit = np.flatnonzero(~readings.held_out)
    with threadpool_limits(1, "blas"):  # matrices of this size gain nothing from threads
        problem, rest = converged_fit(
            parameters, how, readings[to_fit], metrology, progress or _silent
        )
        missing = missing_effects(problem, rest)
    return SessionFit(parameters, how, metrology, readings, problem, rest, lonely, missing)


def judged(
    model: Model,
    fit: SessionFit,
    *,
    declined: tuple[str, ...] = (),
    expected: Expectation | None = None,
    diagnose: bool = True,
    progress: Progress | None = None,
) -> Calibration:
    """Return a fit judged on the held-out readings: the one look at them.

    ``model`` is the arm as the cell had it; ``declined`` are further effects that were fitted and
    not borne out.
    """
    report = progress or _silent
    parameters, readings = fit.parameters, fit.readings
    problem, rest, how = fit.problem, fit.rest, fit.observable
    to_fit = np.flatnonzero(~readings.held_out)
    missing = tuple(e for e in fit.missing if e.name not in declined)
    with threadpool_limits(1, "blas"):
        report("judging")
        found = parameters.model(rest.values)
        remainder = check_held_out(problem, rest, found, readings, fit.metrology)
        diagnosis = diagnosed(found, readings, rest, fit.metrology, report) if diagnose else None
    estimates = fit.estimates(expected)
    shown = np.array([e.shown for e in estimates], dtype=bool)
    errors = _errors(model, found, how, readings, rest.nuisance)
    odds = _stages_at_odds(problem, rest)
    complete = rest.converged and remainder.is_consistent and not missing
    complete = complete and (diagnosis is None or diagnosis.verdict is Verdict.NO_GAP)
    remaining = remaining_of(remainder, diagnosis, complete, missing, rest.converged)
    notes = (*fit.notes, *notes_of(problem, rest, remainder, odds, estimates))
    return Calibration(
        model=found, nominal=model, readings=readings, estimates=estimates,
        covariance=rest.covariance[np.ix_(shown, shown)],
        combinations=(*parameters.redundant, *combinations(parameters, rest, shown)),
        before=errors[0], after=errors[1],
        held_out_before=errors[2], held_out_after=errors[3],
        outliers=to_fit[~rest.inliers], noise=rest.noise.coordinate(),
        repeatability=repeatability_of(problem, rest, found, readings),
        stations=rest.nuisance.stations,
        tcp_std=tcp_deviation(parameters, rest, readings[readings.held_out]),
        diagnosis=diagnosis, complete=complete,
        remaining=remaining, notes=notes,
        instrument_noise=rest.noise.instrument, turn_noise=_turn_noise(how, rest.noise),
        joint_noise=rest.noise.joint, freedom=rest.freedom,
        whole_covariance=rest.covariance, missing_effects=tuple(effect.name for effect in missing),
        noise_floor=_floor(diagnosis),
    )  # fmt: skip


def _silent(text: str) -> None:
    """Report to nobody."""


def _floor(diagnosis: Diagnosis | None) -> float:
    """Return the noise floor of the measured positions (m); nan where nobody measured it."""
    channels = () if diagnosis is None else diagnosis.channels
    floors = [c.noise_floor_rms for c in channels if c.channel == "position"]
    return float("nan") if not floors or floors[0] is None else float(floors[0])


def _with_places(readings: Readings, how: Observable) -> tuple[Readings, tuple[Note, ...]]:
    """Return the readings with those to verify fitted where too few others determine their place.

    Where an instrument stands, or a target sits, only readings there can say; and a note of it.
    """
    layout = how.layout(readings)
    unknown = len(layout.frame) + int(layout.length)
    # one reading more than there are equations for: two positions leave a frame free to turn
    enough = unknown // how.equations + 1 if unknown else 1
    held, fitted = readings.held_out, ~readings.held_out
    alone = np.zeros(len(readings), dtype=bool)
    for place, least in ((readings.station, enough), (readings.target, 1)):
        for one in np.unique(place):  # poses, not readings: a second visit is no second point
            if len(np.unique(readings.pose[fitted & (place == one)])) < least:
                alone |= held & (place == one)
    if not alone.any():
        return readings, ()
    note = Note(Reason.VERIFYING_FITTED, (int(alone.sum()),))
    return replace(readings, held_out=held & ~alone), (note,)


def estimates_of(
    parameters: Parameters, rest: FitState, expected: Expectation | None
) -> tuple[Estimate, ...]:
    """Return the parameters as they are reported, beside what was ``expected`` of them."""
    planned = {} if expected is None else dict(
        zip(expected.names, expected.std, strict=True)
    )  # fmt: skip
    std = np.sqrt(np.diag(rest.covariance))
    estimates = []
    for i, name in enumerate(parameters.names):
        planned_std = planned.get(name)
        estimates.append(
            Estimate(
                name, float(rest.values[i]), float(std[i]), parameters.units[i],
                None if planned_std is None else float(planned_std),
                shown=bool(std[i] < IDENTIFIABLE * parameters.scales[i]),
                on_bound=bool(rest.stuck[i]), freedom=rest.freedom,
            )
        )  # fmt: skip
    return tuple(estimates)


def _errors(
    model: Model, found: Model, observable: Observable, readings: Readings, nuisance: Nuisance
) -> tuple[Errors, Errors, Errors, Errors]:
    """Return errors before and after over the fitted poses, then over the held-out ones.

    Before, the instrument's place is the one that suits the nominal model best.
    """
    fitted, held = np.flatnonzero(~readings.held_out), np.flatnonzero(readings.held_out)
    placed = observable.start(model, readings[fitted])
    errors = []
    for rows in (fitted, held):
        for one, place in ((model, placed), (found, nuisance)):
            gap = np.zeros((0, min(observable.equations, 3)))
            if len(rows):
                gap = observable.residual(one, readings[rows], place)[:, :3]
            errors.append(Errors(gap, rows))
    return errors[0], errors[1], errors[2], errors[3]


def _turn_noise(observable: Observable, noise: Noise) -> float:
    """Return 1 sigma of a measured rotation (rad); nan where none is measured."""
    if len(noise.sizes) < 3:
        return float("nan")
    return float(noise.sizes[1] * observable.sigmas[3])


def _stages_at_odds(problem: Problem, rest: FitState) -> float | None:
    return at_odds(
        rest.system, problem.stages, rest.covariance, problem.bounds,
        problem.observable.equations, np.sqrt(rest.weights),
    )  # fmt: skip


def tcp_deviation(parameters: Parameters, rest: FitState, readings: Readings) -> Array:
    """Return 1 sigma (3D, m) of the predicted TCP at readings (M,): the parameters' part alone."""
    if not len(readings):
        return np.zeros(0)
    J = parameters.tcp_jacobian(rest.values, readings.q, readings.loads)
    return np.asarray(np.sqrt(np.einsum("nki,ij,nkj->n", J, rest.covariance, J)))
