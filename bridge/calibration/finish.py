"""The end of a session: fit, verification, diagnosis, report, and the new cell after a yes."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from bridge.calibration.book import Book
from bridge.calibration.log_of import write_log
from bridge.calibration.order import Order
from bridge.calibration.planning import effects_of, metrology_of, observable_of
from bridge.calibration.talk import Talk
from bridge.calibration.words import TOLD_IN, figure, millimetres
from bridge.cell import Cell, save_cell
from bridge.output_file import require_writable, write_text
from core.calibration.fit import calibrate
from core.calibration.parameters import Parameters
from core.calibration.promise import document_of
from core.calibration.result import Calibration, Errors

LEAST_TOLD = 2e-6  # m: a repeatability below this is none that was seen
DIAGNOSED = ("position", "pose")  # kinds whose remainder the diagnosis can judge


def finish(cell: Cell, order: Order, talk: Talk, book: Book) -> None:
    """Fit what was measured, tell it, report it, and write the new cell once a person says yes."""
    folder = book.journal.path.parent
    talk.say()
    found = _fitted(cell, order, talk, book)
    _tell(talk, found)
    metrology = metrology_of(cell, order.instrument, book.station + 1)
    write_log(found.readings, metrology.registered, folder / "readings.csv")
    promise = json.dumps(document_of(found, sigma=metrology.sigma), indent=1) + "\n"
    write_text(folder / "promise.json", promise)
    for file in _reported(cell, order, book, found):
        talk.say(f"{file}: written")
    _hand_over(cell, order, talk, book, found, promise)


def _fitted(cell: Cell, order: Order, talk: Talk, book: Book) -> Calibration:
    assert book.plan is not None
    kind, places = order.instrument.measures, book.station + 1
    observable = observable_of(cell, order.instrument, places)
    metrology = metrology_of(cell, order.instrument, places)
    with talk.waiting("fitting") as tell:
        parameters = Parameters.of(cell.model, effects_of(cell), observable=observable)
        return calibrate(
            cell.model, book.readings(kind), parameters, metrology, observable=observable,
            expected=book.plan.expected, diagnose=kind in DIAGNOSED,
            progress=lambda text: tell(f"fitting: {text}"),
        )  # fmt: skip


def _tell(talk: Talk, found: Calibration) -> None:
    talk.say(found.verdict, "bold green" if found.complete else "bold yellow")
    pairs = (
        ("fitted poses", found.before, found.after),
        ("poses to verify", found.held_out_before, found.held_out_after),
    )
    for name, before, after in pairs:
        if len(after.vector):
            talk.say(f"  {name}: {_errors(before)} before, {_errors(after)} after")
    noise = f"  noise {millimetres(found.noise)} a coordinate"
    if np.isfinite(found.repeatability):
        small = found.repeatability < LEAST_TOLD
        noise += ", the arm repeats " + (
            "better than the instrument tells" if small
            else f"to {millimetres(found.repeatability)}"
        )  # fmt: skip
    talk.say(noise)
    talk.console.print(_table(found))
    for row in found.outliers:
        talk.say(f"  weighed down as wild: reading {int(row) + 1}")
    for line in found.notes:
        talk.say(f"  note: {line}")
    if found.combinations:
        talk.say(f"  {len(found.combinations)} parameters cannot be told from others; the report "
                 "names them")  # fmt: skip


def _errors(errors: Errors) -> str:
    return f"{millimetres(errors.mean)} in the mean, {millimetres(errors.max)} at most"


def _table(found: Calibration) -> Table:
    table = Table(
        title="what the arm has beyond the cell's model (± 1 sigma)", title_justify="left",
        box=SIMPLE_HEAD, padding=(0, 1),
    )  # fmt: skip
    table.add_column("parameter", no_wrap=True)
    for name in ("value", "±", "planned ±"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    for e in found.estimates:
        unit, factor = TOLD_IN.get(e.unit, (e.unit, 1.0))
        planned = "" if e.expected_std is None else figure(e.expected_std * factor)
        spread = figure(e.std * factor) if e.shown else "not shown"
        bound = " (bound)" if e.on_bound else ""
        table.add_row(e.name, figure(e.value * factor), spread, planned, unit + bound)
    return table


def _reported(cell: Cell, order: Order, book: Book, found: Calibration) -> tuple[Path, Path]:
    from bridge.calibration.facts import session_facts
    from bridge.calibration.report import write_report  # pictures take their time

    assert book.plan is not None
    facts = session_facts(cell, order, book)
    return write_report(found, book.plan, facts, book.journal.path.parent)


def _hand_over(
    cell: Cell, order: Order, talk: Talk, book: Book, found: Calibration, promise: str
) -> None:
    """Ask, and write the new cell with its promise beside it; the old cell stays as it is."""
    target = order.new_cell or _free(cell.path.with_name(f"{cell.path.stem}_calibrated.yaml"))
    talk.say()
    if not found.complete:
        talk.warn("something is left that these effects do not explain: see the report")
    known = f", replacing the one that is there since {_since(target)}" if target.exists() else ""
    question = f"Write the calibrated cell to {target}{known}? {cell.path} stays as it is."
    if not order.yes and not talk.confirm(question):
        book.add("ended", applied=None)
        talk.say(f"nothing is applied; the fit and its report stay in {book.journal.path.parent}")
        return
    require_writable(target, cell.path)
    save_cell(cell, target, found.model)
    write_text(promise_beside(target), promise)
    book.add("ended", applied=str(target.resolve()))
    talk.say(f"{target}: written", "bold")
    talk.say(f"  months later: gapbridge calibrate {target} --verify")


def promise_beside(cell: Path) -> Path:
    """Return where a calibrated cell's promise is kept."""
    return cell.with_name(f"{cell.stem}.promise.json")


def _since(path: Path) -> str:
    return datetime.fromtimestamp(path.stat().st_mtime).strftime("%Y-%m-%d %H:%M")


def _free(path: Path) -> Path:
    """Return the path, or the first numbered one beside it that is free."""
    names = [path, *(path.with_name(f"{path.stem}_{i}{path.suffix}") for i in range(2, 1000))]
    return next(p for p in names if not p.exists())
