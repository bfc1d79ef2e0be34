"""``gapbridge fit``."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from bridge.cell import save_cell
from bridge.cli.options import cell_option, log_argument, open_cell, open_log
from bridge.cli.progress import progress
from bridge.output_file import require_writable
from core.errors import ExcitationError
from core.identification import Identification, identify_compliance
from core.model import Array

CRUMB = 1e-15  # rad/Nm: turns no joint by anything


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
    the same cell with the flexibilities found. Declines, with the reason, where nothing in the log
    excites the compliance.

    Example: gapbridge fit log.csv --cell cell.yaml --out calibrated.yaml
    """
    given = open_cell(cell)
    rows = open_log(log, given)
    require_writable(out, log, cell)
    try:
        with progress("fitting"):
            found = identify_compliance(given.model, rows, given.metrology)
    except ExcitationError as error:
        raise ExcitationError(f"{log}: {error}") from None
    model = given.model.with_compliance(_rounded(found.axial), _rounded(found.radial))
    save_cell(given, out, model)
    tell(found)
    click.echo(f"{out}: written")


def _rounded(flexibility: Array) -> list[float]:
    """Return flexibilities (rad/Nm) without the crumbs that a bound of zero leaves behind."""
    return [float(v) if abs(v) > CRUMB else 0.0 for v in flexibility]


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
    held_out = found.remaining_rms_held_out
    carried = (
        f", on poses left out of the fit {held_out * 1e3:.4f}" if np.isfinite(held_out) else ""
    )
    click.echo(
        f"gap per coordinate over {found.samples} poses, rms in mm: {found.gap_rms * 1e3:.4f} "
        f"before, {found.remaining_rms * 1e3:.4f} after{carried}"
    )
    for line in (*found.notes, *found.combinations):
        click.echo(f"note: {line}")


def _cells(value: float, std: float, shown: bool) -> tuple[str, str]:
    return f"{value * 1e6:.4f}", f"{std * 1e6:.4f}" if shown else "not shown"
