"""What a session's readings come to: the fit, and how it is reported."""

from __future__ import annotations

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from gapbridge.bridge.calibration.format import SHOWN_IN, figure, millimetres
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.planning import effects_of, metrology_of, observable_of
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.session import Session
from gapbridge.bridge.cell import Cell
from gapbridge.core.calibration.fit import SessionFit, fit_session, judged
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.result import Calibration, Errors

LEAST_SEEN = 2e-6  # m: a repeatability below this is none that was seen
DIAGNOSED = ("position", "pose")  # kinds whose remainder the diagnosis can judge


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
        return judged(
            cell.model, fit, declined=declined, expected=session.plan.expected,
            diagnose=options.instrument.measures in DIAGNOSED,
            progress=lambda text: emit(f"verifying: {text}"),
        )  # fmt: skip


def report_calibration(prompt: Prompt, found: Calibration) -> None:
    """Say what a fit has found, how far it carries, and what stays unknown."""
    prompt.say(found.verdict, "bold green" if found.complete else "bold yellow")
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
    for line in found.notes:
        prompt.say(f"  note: {line}")
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
        unit, factor = SHOWN_IN.get(e.unit, (e.unit, 1.0))
        planned = "" if e.expected_std is None else figure(e.expected_std * factor)
        spread = figure(e.std * factor) if e.shown else "not identifiable"
        bound = " (bound)" if e.on_bound else ""
        table.add_row(e.name, figure(e.value * factor), spread, planned, unit + bound)
    return table
