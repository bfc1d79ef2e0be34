"""The calibration of an arm: plan, fit, verification, report and the calibrated cell."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from gapbridge.bridge.calibration.format import (
    duration,
    load_text,
    millimetres,
    number_text,
    quantity_text,
)
from gapbridge.bridge.calibration.jobs.job import Job, document_text, write_log
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.planning import effects_of, make_plan, metrology_of, observable_of
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.session import Session, seconds_left
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.document.notes import calibration_text, note_text
from gapbridge.bridge.document.numbers import unit_of
from gapbridge.bridge.document.output_file import write_text
from gapbridge.bridge.document.provenance import fitted as fit_provenance
from gapbridge.bridge.document.provenance import provenance
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.accuracy_baseline import baseline_document
from gapbridge.core.calibration.fit import SessionFit, evaluate_fit, fit_session
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.missing_effects import MissingEffect
from gapbridge.core.calibration.plan import Plan
from gapbridge.core.calibration.result import Calibration, Errors
from gapbridge.core.calibration.spread import Spread
from gapbridge.core.calibration.summary import unsupported
from gapbridge.core.effects import names_part_of
from gapbridge.core.fitted_range import range_of
from gapbridge.core.log.log import read_log

MAX_REFITS = 3  # with effects that the first fit lacks
MIN_REPEATABILITY = 2e-6  # m, below which it is not given
DIAGNOSABLE_KINDS = ("position", "pose")  # kinds of readings whose residual can be diagnosed


class CalibrationJob(Job):
    """Calibrates an arm: plan, fit, verification, report, new cell."""

    def plan(self, begin: Array | None, emit: Callable[[str, float], None]) -> Plan:
        """Return the plan with the most informative poses."""
        return make_plan(self.cell, self.options, emit)

    def report_plan(self, plan: Plan) -> None:
        """Print the number of stops, and the expected accuracy by number of poses."""
        prompt, minutes = self.prompt, self.cell.calibration.minutes_per_load
        fit = sum(not p.held_out and not p.repeat for p in plan.poses)
        held_out = sum(p.held_out for p in plan.poses)
        repeats = sum(p.repeat > 0 for p in plan.poses)
        prompt.say(
            f"plan: {fit} poses to fit, {held_out} to verify, {repeats} once more for the "
            f"repeatability: {len(plan.poses)} stops, "
            f"{duration(seconds_left(self.session, minutes) + plan.travel)}"
        )
        self._report_places(plan)
        used = {p.load for p in plan.poses}
        for i, load in enumerate(plan.loads):
            unused = "" if i in used else " (not needed: it would add nothing)"
            prompt.say(f"  load {i + 1}: {load_text(load)}{unused}")
        prompt.say(
            f"expected: the predicted TCP known to {millimetres(plan.expected.tcp_std)} (1 sigma "
            f"over workspace and loads; {millimetres(plan.expected.tcp_std_worst)} at worst)"
        )
        spreads = ", ".join(f"{n}: {millimetres(s)}" for n, s in plan.bought)
        prompt.say(f"  expected accuracy by number of poses: {spreads}")
        weak = _poorly_determined(plan)
        if weak:
            prompt.say(f"  poorly determined by these poses: {', '.join(weak)}")
        for note in plan.notes:
            prompt.say(f"  note: {note_text(note)}")

    def _report_places(self, plan: Plan) -> None:
        """Print the planned positions of an instrument that is moved during the session."""
        settings = self.cell.calibration
        for i, position in enumerate(
            settings.further_places and [settings.instrument_at, *settings.further_places]
        ):
            count = sum(p.station == i for p in plan.poses)
            place = ", ".join(f"{v:g}" for v in position or ())
            unused = "" if count else " (not needed: nothing more is visible from there)"
            self.prompt.say(f"  place {i + 1}: ({place}) m in base, {count} stops{unused}")

    def _confirm_effects(self, missing: tuple[MissingEffect, ...]) -> bool:
        """Ask whether to fit effects as well that reduce the cross-validated error."""
        shares = ", ".join(f"{effect.name} {100 * effect.share:.0f} %" for effect in missing)
        names = ", ".join(effect.name for effect in missing)
        self.prompt.say(
            f"on poses left out of the fit in turn, this reduces the remaining error: {shares}"
        )
        question = f"The fitted poses indicate {names} as well. Fit again with it?"
        return self.options.yes or self.prompt.confirm(question)

    def _with_missing_effects(self, fit: SessionFit) -> tuple[SessionFit, tuple[str, ...]]:
        """Return the fit extended by confirmed effects, and the names of rejected effects.

        Held-out poses are not used. An effect is rejected if all its values are within three
        standard deviations of zero.
        """
        added: tuple[str, ...] = ()
        rejected: tuple[str, ...] = ()
        for _ in range(MAX_REFITS):
            new = tuple(effect for effect in fit.missing if effect.name not in (*added, *rejected))
            if not new or not self._confirm_effects(new):
                break
            names = (*added, *(effect.name for effect in new))
            further = run_fit(self.cell, self.options, self.prompt, self.session, names)
            while unfit := unsupported(further.estimates(), names):
                for name in unfit:
                    self._report_rejected(name, further)
                rejected += unfit
                names = tuple(name for name in names if name not in rejected)
                if names == added:
                    further = fit
                    break
                further = run_fit(self.cell, self.options, self.prompt, self.session, names)
            if names == added:
                break
            fit, added = further, names
        return fit, rejected

    def _report_rejected(self, name: str, fit: SessionFit) -> None:
        estimates = [e for e in fit.estimates() if names_part_of(e.name, name)]
        values = ", ".join(f"{e.name} = {quantity_text(e.value, e.unit)} ± "
                           f"{quantity_text(e.std, e.unit)}" for e in estimates)  # fmt: skip
        self.prompt.warn(f"not fitted: {values} is less than three standard deviations from zero")

    def finish(self) -> None:
        """Fit, evaluate and report; write the new cell if the operator confirms."""
        prompt, folder, options = self.prompt, self.folder, self.options
        prompt.say()
        fit = run_fit(self.cell, options, prompt, self.session)
        fit, rejected = self._with_missing_effects(fit)
        result = evaluate_session(self.cell, options, prompt, self.session, fit, rejected)
        report_calibration(prompt, result, [r.stop for r in self.session.accepted])
        metrology = metrology_of(self.cell, options.instrument, self.session.station_count)
        write_log(result.readings, metrology.registered, folder / "readings.csv")
        origin = provenance({"log": [folder / "readings.csv"], "cell": [self.cell.path]})
        baseline = baseline_document(result, sigma=metrology.sigma)
        baseline |= {"verdict": calibration_text(result), "provenance": origin}
        write_text(folder / "promise.json", document_text(baseline))
        from gapbridge.bridge.calibration.jobs.facts import (
            session_facts,  # plotting is slow to import
        )
        from gapbridge.bridge.calibration.report import (
            CalibrationData,
            required_accuracy,
            write_report,
        )

        facts = session_facts(self.cell, options, self.session)
        data = CalibrationData(result, self.session.plan, facts)
        for file in write_report(data, folder):
            prompt.say(f"{file}: written")
        if facts.accuracy is not None:
            verdict = required_accuracy(data)
            prompt.say(f"{verdict.badge.text}: {verdict.text}", "bold")
        if not result.complete:
            prompt.warn(f"not complete: {note_text(result.remaining)}")
        if (why := worse_than_before(result.held_out_before, result.held_out_after)) is not None:
            self.session.add("ended", applied=None)
            prompt.warn(why)
            return
        log = read_log(folder / "readings.csv", self.cell.arm.n)
        spread = Spread(tuple(e.name for e in result.estimates), result.whole_covariance)
        intervals = self.cell.intervals | {e.name: e.interval for e in result.estimates if e.shown}
        sections = {"provenance": fit_provenance(origin, range_of(log), spread, intervals)}
        target = self.write_new_cell(result.model, "the calibrated cell", sections, baseline)
        if target is not None:
            prompt.say(f"  months later: gapbridge calibrate {target} --verify")


def worse_than_before(before: Errors, after: Errors) -> str | None:
    """Return why a fit is not applied: larger errors (m) on held-out poses; None: it is applied."""
    if not after.rms > before.rms:  # without held-out poses both are nan
        return None
    return (
        f"on poses that the fit never saw the error rises from {1e3 * before.rms:.3f} to "
        f"{1e3 * after.rms:.3f} mm rms: nothing is applied; fit fewer effects, or more poses"
    )


def _poorly_determined(plan: Plan) -> list[str]:
    """Return parameters whose expected standard deviation exceeds their prior's."""
    expected = plan.expected
    rows = zip(expected.names, expected.units, expected.std, expected.prior, strict=True)
    return [
        f"{name} (±{quantity_text(std, unit)})"
        for name, unit, std, prior in rows
        if not np.isfinite(std) or std > prior
    ]


def run_fit(
    cell: Cell, options: SessionOptions, prompt: Prompt, session: Session,
    more: tuple[str, ...] = (),
) -> SessionFit:  # fmt: skip
    """Return the fit of a session's readings, with effects ``more`` added to those of the cell.

    Held-out poses are not used. Raises InputError if the readings are too few.
    """
    kind, places = options.instrument.measures, session.station_count
    observable = observable_of(cell, options.instrument, places)
    metrology = metrology_of(cell, options.instrument, places)
    with prompt.waiting("fitting") as emit:
        parameters = identifiable_parameters(
            cell.model, (*effects_of(cell), *more), observable=observable
        )
        return fit_session(
            session.all_readings(kind), parameters, metrology, observable=observable,
            progress=lambda text: emit(f"fitting: {text}"),
        )  # fmt: skip


def evaluate_session(
    cell: Cell, options: SessionOptions, prompt: Prompt, session: Session, fit: SessionFit,
    rejected: tuple[str, ...],
) -> Calibration:  # fmt: skip
    """Return the fit, ``rejected`` effects noted, evaluated on the held-out poses."""
    assert session.plan is not None
    with prompt.waiting("verifying") as emit:
        return evaluate_fit(
            cell.model, fit, declined=rejected, expected=session.plan.expected,
            diagnose=options.instrument.measures in DIAGNOSABLE_KINDS,
            progress=lambda text: emit(f"verifying: {text}"),
        )  # fmt: skip


def report_calibration(prompt: Prompt, result: Calibration, stops: Sequence[int]) -> None:
    """Print the result of a fit: errors, noise, parameters, what is not identifiable.

    ``stops`` (N,) are those of the readings, from 0.
    """
    prompt.say(calibration_text(result), "bold green" if result.complete else "bold yellow")
    pairs = (
        ("fitted poses", result.before, result.after),
        ("poses to verify", result.held_out_before, result.held_out_after),
    )
    for name, before, after in pairs:
        if len(after.vector):
            prompt.say(f"  {name}: {_errors(before)} before, {_errors(after)} after")
    noise = f"  residual {millimetres(result.noise)} per coordinate (1 sigma)"
    if np.isfinite(result.noise_floor):
        noise += f", noise of instrument and arm {millimetres(result.noise_floor)}"
    if np.isfinite(result.repeatability):
        small = result.repeatability < MIN_REPEATABILITY
        text = "too small to be measured" if small else millimetres(result.repeatability)
        noise += f", repeatability of the arm {text}"
    prompt.say(noise)
    prompt.console.print(_table(result))
    for row in result.outliers:
        prompt.say(f"  outlier, down-weighted: reading {int(row) + 1}, of stop {stops[row] + 1}")
    for note in result.notes:
        prompt.say(f"  note: {note_text(note)}")
    if result.combinations:
        prompt.say(f"  {len(result.combinations)} parameters cannot be separated; the report "
                 "names them")  # fmt: skip


def _errors(errors: Errors) -> str:
    return f"{millimetres(errors.mean)} mean, {millimetres(errors.max)} at most"


def _table(result: Calibration) -> Table:
    table = Table(
        title="corrections to the cell's model (± 1 sigma)", title_justify="left",
        box=SIMPLE_HEAD, padding=(0, 1),
    )  # fmt: skip
    table.add_column("parameter", no_wrap=True)
    for name in ("value", "±", "planned ±"):
        table.add_column(name, justify="right", no_wrap=name != "±")
    table.add_column("")
    for e in result.estimates:
        unit, factor = unit_of(e.unit)
        planned = "" if e.expected_std is None else number_text(e.expected_std * factor)
        spread = number_text(e.std * factor) if e.shown else "not identifiable"
        bound = " (bound)" if e.on_bound else ""
        table.add_row(e.name, number_text(e.value * factor), spread, planned, unit + bound)
    return table
