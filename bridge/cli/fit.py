"""``gapbridge fit``."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from bridge.cell import Cell, save_cell
from bridge.cli.large_log import LargeLog, is_large
from bridge.cli.options import cell_option, log_argument, open_cell, open_log
from bridge.cli.progress import progress, status
from bridge.document.output_file import require_writable
from core.errors import ExcitationError
from core.estimation.identification import Identification, identify_compliance
from core.estimation.streamed import identify_streamed


@click.command()
@log_argument
@cell_option
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="The new cell file to write."
)
def fit(log: Path, cell: Path, out: Path) -> None:
    """Identify the compliance of a cell from a log.

    Least squares on measured TCP poses (measured_position, and measured_rotation where the log has
    it) under different payloads or pulls. Effects that are in the cell stay in it. Writes NEW_CELL:
    the same cell with the flexibilities found; what the log does not show stays as it is in the
    cell, and is told. Where the metrology is not registered, its frame and the tool point are
    estimated along, before as well as after, and not written. Declines, with the reason, where
    nothing in the log excites the compliance. A log of more than 20,000 rows is read in pieces,
    so that memory does not grow with it; so is a recording of the daemon (.mcap).

    Example: gapbridge fit log.csv --cell cell.yaml --out calibrated.yaml
    """
    given = open_cell(cell)
    require_writable(out, log, cell)
    try:
        found = _identified(log, given)
    except ExcitationError as error:
        raise ExcitationError(f"{log}: {error}") from None
    # frame and tool point that were estimated along stay out of the cell
    save_cell(given, out, given.model.with_compliance(found.axial, found.radial))
    tell(found)
    click.echo(f"{out}: written")


def _identified(path: Path, cell: Cell) -> Identification:
    """Return what the log shows; one of many rows passes by in pieces."""
    if is_large(path):
        with status("fitting") as tell_step:
            return identify_streamed(
                cell.model, LargeLog(path, cell), cell.metrology, progress=tell_step
            )
    rows = open_log(path, cell)
    with progress("fitting"):
        return identify_compliance(cell.model, rows, cell.metrology)


def tell(found: Identification) -> None:
    """Print flexibilities with their spread, how far they carry, and what stays unknown."""
    table = Table(title="joint flexibility, 1e-6 rad/Nm", title_justify="left")
    for column in ("joint", "axial", "±", "radial", "±"):
        table.add_column(column, justify="right")
    n = len(found.axial)
    for i in range(n):
        table.add_row(
            str(i + 1),
            *_cells(found.axial[i], found.std_axial[i], bool(found.identifiable[i])),
            *_cells(found.radial[i], found.std_radial[i], bool(found.identifiable[n + i])),
        )
    console = Console()
    console.print(table)
    click.echo(
        f"gap per coordinate over {found.samples} poses, rms in mm: "
        f"{_change(found.gap_rms, found.remaining_rms)}"
    )
    if np.isfinite(found.remaining_rms_held_out):
        change = _change(found.gap_rms_held_out, found.remaining_rms_held_out)
        click.echo(f"on poses left out of the fit: {change}")
    for line in (*found.notes, *found.combinations):
        click.echo(f"note: {line}")


def _change(before: float, after: float) -> str:
    return f"{before * 1e3:.4f} before, {after * 1e3:.4f} after"


def _cells(value: float, std: float, shown: bool) -> tuple[str, str]:
    return f"{value * 1e6:.4f}", f"{std * 1e6:.4f}" if shown else "not shown"
