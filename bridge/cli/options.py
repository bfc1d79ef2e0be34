"""What several commands share: arguments, and how a log is read for a cell."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from bridge.cell import Cell, load_cell
from core.diagnosis.log_checks.units_and_clocks import check_units
from core.errors import LogError
from core.load_bounds import HEAVIEST
from core.log.log import Log, read_log

log_argument = click.argument("log", type=click.Path(path_type=Path))
cell_argument = click.argument("cell", type=click.Path(path_type=Path))
cell_option = click.option(
    "--cell", required=True, type=click.Path(path_type=Path), help="The cell file (YAML)."
)
csv_option = click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="The CSV file to write."
)


def open_cell(path: Path) -> Cell:
    """Return a cell; its warnings go to stderr."""
    cell = load_cell(path)
    for warning in cell.warnings:
        click.echo(f"warning: {warning}", err=True)
    return cell


def open_log(path: Path, cell: Cell) -> Log:
    """Return a log for a cell's arm.

    Raises LogError where a payload is out of range, angles look like degrees or positions like
    millimetres.
    """
    log = read_log(path, cell.arm.n)
    check_log(log, cell)
    return log


def check_log(log: Log, cell: Cell) -> None:
    """Raise LogError where a log's numbers cannot be meant for a cell's arm."""
    for name in ("actual_q", "target_q"):
        if np.isinf(log.columns.get(name, np.zeros(0))).any():
            log.require(name)  # names the cell
    check_units(cell.model, log)
    mass, rated = log.get("payload"), cell.arm.payload
    if mass is not None and (mass > HEAVIEST * rated).any():
        row = int(np.argmax(mass > HEAVIEST * rated))
        raise LogError(
            f"{log.path}: row {log.line(row)}, column payload: found {mass[row]:g} kg, out of "
            f"range: expected 0 to {rated:g} kg, what {cell.arm.name} is rated for"
        )
