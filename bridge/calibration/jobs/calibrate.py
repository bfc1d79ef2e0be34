"""A whole calibration: from an unknown arm to a cell that compensates."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from gapbridge.bridge.calibration.format import (
    duration,
    figure,
    load_text,
    millimetres,
    parameter,
)
from gapbridge.bridge.calibration.jobs.job import Job, write_document, write_log
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.planning import effects_of, metrology_of, observable_of, planned
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.session import Session, seconds_left
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.document.notes import calibration_text, note_text
from gapbridge.bridge.document.provenance import fitted as fitted_on
from gapbridge.bridge.document.provenance import provenance
from gapbridge.bridge.report.labels import unit_of
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

REFITS = 3  # times at most that the readings may ask for more
LEAST_SEEN = 2e-6  # m: a repeatability below this is none that was seen
DIAGNOSED = ("position", "pose")  # kinds whose remainder the diagnosis can judge


def baseline_beside(cell: Path) -> Path:
    """Return where a calibrated cell's accuracy baseline is kept."""
    return cell.with_name(f"{cell.stem}.promise.json")


class WholeJob(Job):
    """Plan, measure, fit, verify, report, and a new cell."""

    def plan(self, begin: Array | None, emit: Callable[[str, float], None]) -> Plan:
        """Return the most informative poses."""
        return planned(self.cell, self.options, emit)

    def report_plan(self, plan: Plan) -> None:
        """Print the number of stops, and the accuracy to expect of n poses."""
        prompt, minutes = self.prompt, self.cell.calibration.minutes_per_load
        fit = sum(not p.held_out and not p.repeat for p in plan.poses)
        held = sum(p.held_out for p in plan.poses)
        again = sum(p.repeat > 0 for p in plan.poses)
        prompt.say(
            f"plan: {fit} poses to fit, {held} to verify, {again} once more for the repeatability: "
            f"{len(plan.poses)} stops, "
            f"{duration(seconds_left(self.session, minutes) + plan.travel)}"
        )
        self._report_places(plan)
        used = {p.load for p in plan.poses}
        for i, load in enumerate(plan.loads):
            needless = "" if i in used else " (not needed: it would add nothing)"
            prompt.say(f"  load {i + 1}: {load_text(load)}{needless}")
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
        """Say where the instrument stands in turn, where it is carried about."""
        given = self.cell.calibration
        for i, at in enumerate(
            given.further_places and [given.instrument_at, *given.further_places]
        ):
            count = sum(p.station == i for p in plan.poses)
            place = ", ".join(f"{v:g}" for v in at or ())
            needless = "" if count else " (not needed: nothing more is seen from there)"
            self.prompt.say(f"  place {i + 1}: ({place}) m in base, {count} stops{needless}")

    def _wanted(self, missing: tuple[MissingEffect, ...]) -> bool:
        """Return whether effects that the fitted poses support are to be fitted as well."""
        shares = ", ".join(f"{effect.name} {100 * effect.share:.0f} %" for effect in missing)
        names = ", ".join(effect.name for effect in missing)
        self.prompt.say(
            f"on poses left out of the fit in turn, this reduces the remaining error: {shares}"
        )
        question = f"The fitted poses ask for {names} as well. Fit again with it?"
        return self.options.yes or self.prompt.confirm(question)

    def _chosen(self, fit: SessionFit) -> tuple[SessionFit, tuple[str, ...]]:
        """Return the fit with what the fitted poses support and a person wants; and what fell.

        The held-out poses have no say in it. What is not borne out by its own value falls.
        """
        asked: tuple[str, ...] = ()
        fallen: tuple[str, ...] = ()
        for _ in range(REFITS):
            new = tuple(effect for effect in fit.missing if effect.name not in (*asked, *fallen))
            if not new or not self._wanted(new):
                break
            names = (*asked, *(effect.name for effect in new))
            further = fitted(self.cell, self.options, self.prompt, self.session, names)
            while unfit := unsupported(further.estimates(), names):
                for name in unfit:
                    self._report_declined(name, further)
                fallen += unfit
                names = tuple(name for name in names if name not in fallen)
                if names == asked:
                    further = fit
                    break
                further = fitted(self.cell, self.options, self.prompt, self.session, names)
            if names == asked:
                break
            fit, asked = further, names
        return fit, fallen

    def _report_declined(self, name: str, fit: SessionFit) -> None:
        own = [e for e in fit.estimates() if names_part_of(e.name, name)]
        values = ", ".join(f"{e.name} = {parameter(e.value, e.unit)} ± {parameter(e.std, e.unit)}"
                           for e in own)  # fmt: skip
        self.prompt.warn(f"not fitted: {values} is less than three standard deviations from zero")

    def finish(self) -> None:
        """Fit, show, report, and write the new cell once a person says yes."""
        prompt, folder, options = self.prompt, self.folder, self.options
        prompt.say()
        fit, fallen = self._chosen(fitted(self.cell, options, prompt, self.session))
        found = calibration_of(self.cell, options, prompt, self.session, fit, fallen)
        report_calibration(prompt, found)
        metrology = metrology_of(self.cell, options.instrument, self.session.places)
        write_log(found.readings, metrology.registered, folder / "readings.csv")
        origin = provenance({"log": [folder / "readings.csv"], "cell": [self.cell.path]})
        baseline = baseline_document(found, sigma=metrology.sigma)
        baseline |= {"verdict": calibration_text(found), "provenance": origin}
        write_document(folder / "promise.json", baseline)
        from gapbridge.bridge.calibration.jobs.facts import (
            session_facts,  # pictures take their time
        )
        from gapbridge.bridge.calibration.report import Material, write_report

        facts = session_facts(self.cell, options, self.session)
        for file in write_report(Material(found, self.session.plan, facts), folder):
            prompt.say(f"{file}: written")
        if not found.complete:
            prompt.warn(f"not complete: {note_text(found.remaining)}")
        if (why := worse_than_before(found.held_out_before, found.held_out_after)) is not None:
            self.session.add("ended", applied=None)
            prompt.warn(why)
            return
        log = read_log(folder / "readings.csv", self.cell.arm.n)
        spread = Spread(tuple(e.name for e in found.estimates), found.whole_covariance)
        intervals = self.cell.intervals | {e.name: e.interval for e in found.estimates if e.shown}
        sections = {"provenance": fitted_on(origin, range_of(log), spread, intervals)}
        target = self.hand_over(found.model, "the calibrated cell", sections)
        if target is not None:
            write_document(baseline_beside(target), baseline)
            prompt.say(f"  months later: gapbridge calibrate {target} --verify")


def worse_than_before(before: Errors, after: Errors) -> str | None:
    """Return why a fit is not written: it ran away on unseen poses; None: it did not."""
    if not after.rms > before.rms:  # without held-out poses both are nan
        return None
    return (
        f"on poses that the fit never saw the error rises from {1e3 * before.rms:.3f} to "
        f"{1e3 * after.rms:.3f} mm rms: nothing is applied; fit fewer effects, or more poses"
    )


def _poorly_determined(plan: Plan) -> list[str]:
    """Return the parameters whose expected spread is no less than their usual size."""
    expected = plan.expected
    rows = zip(expected.names, expected.units, expected.std, expected.prior, strict=True)
    return [
        f"{name} (±{parameter(std, unit)})"
        for name, unit, std, prior in rows
        if not np.isfinite(std) or std > prior
    ]


def fitted(
    cell: Cell,
    options: SessionOptions,
    prompt: Prompt,
    session: Session,
    more: tuple[str, ...] = (),
) -> SessionFit:
    """Return the fit of a session's readings, with ``more`` effects than the cell names.

    Nothing of the held-out poses is looked at. Raises InputError where the readings are too few.
    """
    kind, places = options.instrument.measures, session.places
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


def calibration_of(
    cell: Cell,
    options: SessionOptions,
    prompt: Prompt,
    session: Session,
    fit: SessionFit,
    declined: tuple[str, ...],
) -> Calibration:
    """Return the fit judged on the held-out poses: the one look at them."""
    assert session.plan is not None
    with prompt.waiting("verifying") as emit:
        return evaluate_fit(
            cell.model, fit, declined=declined, expected=session.plan.expected,
            diagnose=options.instrument.measures in DIAGNOSED,
            progress=lambda text: emit(f"verifying: {text}"),
        )  # fmt: skip


def report_calibration(prompt: Prompt, found: Calibration) -> None:
    """Say what a fit has found, how far it carries, and what stays unknown."""
    prompt.say(calibration_text(found), "bold green" if found.complete else "bold yellow")
    pairs = (
        ("fitted poses", found.before, found.after),
        ("poses to verify", found.held_out_before, found.held_out_after),
    )
    for name, before, after in pairs:
        if len(after.vector):
            prompt.say(f"  {name}: {_errors(before)} before, {_errors(after)} after")
    noise = f"  the fit leaves {millimetres(found.noise)} a coordinate"
    if np.isfinite(found.noise_floor):
        noise += f", instrument and arm alone {millimetres(found.noise_floor)}"
    if np.isfinite(found.repeatability):
        small = found.repeatability < LEAST_SEEN
        noise += ", the arm repeats " + (
            "better than the instrument reports" if small
            else f"to {millimetres(found.repeatability)}"
        )  # fmt: skip
    prompt.say(noise)
    prompt.console.print(_table(found))
    for row in found.outliers:
        prompt.say(f"  outlier, down-weighted: reading {int(row) + 1}")
    for note in found.notes:
        prompt.say(f"  note: {note_text(note)}")
    if found.combinations:
        prompt.say(f"  {len(found.combinations)} parameters cannot be separated; the report "
                 "names them")  # fmt: skip


def _errors(errors: Errors) -> str:
    return f"{millimetres(errors.mean)} mean, {millimetres(errors.max)} at most"


def _table(found: Calibration) -> Table:
    table = Table(
        title="what the arm has beyond the cell's model (± 1 sigma)", title_justify="left",
        box=SIMPLE_HEAD, padding=(0, 1),
    )  # fmt: skip
    table.add_column("parameter", no_wrap=True)
    for name in ("value", "±", "planned ±"):
        table.add_column(name, justify="right", no_wrap=name != "±")
    table.add_column("")
    for e in found.estimates:
        unit, factor = unit_of(e.unit)
        planned = "" if e.expected_std is None else figure(e.expected_std * factor)
        spread = figure(e.std * factor) if e.shown else "not identifiable"
        bound = " (bound)" if e.on_bound else ""
        table.add_row(e.name, figure(e.value * factor), spread, planned, unit + bound)
    return table
