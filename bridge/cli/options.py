"""What several commands share: arguments, and how a log is read for a cell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

from bridge.cell import Cell, load_cell
from bridge.cell.cell import HEAVIEST
from core.diagnosis.log_checks.units_and_clocks import check_units
from core.errors import LogError
from core.log.log import Log, read_log
from core.log.ranges import outside
from core.log.sessions import join_sessions
from core.log.sources import SourceOptions, source_of

log_argument = click.argument("log", type=click.Path(path_type=Path))
logs_argument = click.argument(
    "logs", metavar="LOG...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
remounted_option = click.option(
    "--remounted",
    is_flag=True,
    help="The target was taken off between sessions: each has a tool point of its own.",
)
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
    """Return a log for a cell's arm: a CSV or Parquet file, or another source (core.log.sources).

    Raises LogError where a payload is out of range, angles look like degrees or positions like
    millimetres.
    """
    source = source_of(path)
    if source is None:
        log = read_log(path, cell.arm.n)
    else:
        converted = source.read(path, joint_names(cell), SourceOptions())
        for note in converted.notes:
            click.echo(f"note: {path}: {note}", err=True)
        log = converted.log(path, cell.arm.n)
    check_log(log, cell)
    return log


def joint_names(cell: Cell) -> tuple[str, ...]:
    """Return the names of the cell's joints: those of its URDF, or joint_1, joint_2, ..."""
    return cell.arm.joint_names or tuple(f"joint_{i + 1}" for i in range(cell.arm.n))


def open_logs(paths: Sequence[Path], cell: Cell) -> Log:
    """Return one log, or several as the sessions of one; so is one with a column ``session``.

    Raises LogError as ``open_log`` does, and where the sessions do not belong together.
    """
    return join_sessions([open_log(path, cell) for path in paths], cell.model)


def warn_outside(log: Log, cell: Cell) -> None:
    """Print a warning where a log's poses, loads or temperatures lie outside what was fitted.

    What was fitted stands in the cell's ``provenance``; cells without one give no warning.
    """
    for text in outside(log, cell.fitted_range):
        click.echo(f"warning: {log.path}: {text}", err=True)


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
