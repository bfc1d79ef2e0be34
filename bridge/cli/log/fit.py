"""``gapbridge fit``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from gapbridge.bridge.api.uncertainty import fit_intervals
from gapbridge.bridge.cell import Cell, save_cell
from gapbridge.bridge.cell.log_fit import pose_findings
from gapbridge.bridge.cli.log.large_log import LargeLog, has_sessions, is_large
from gapbridge.bridge.cli.options import (
    FILE,
    cell_option,
    logs_argument,
    open_cell,
    open_logs,
    remounted_option,
)
from gapbridge.bridge.cli.progress import progress, status
from gapbridge.bridge.document.notes import note_texts
from gapbridge.bridge.document.output_file import require_writable
from gapbridge.bridge.document.provenance import fitted, provenance
from gapbridge.core.calibration.spread import Spread
from gapbridge.core.effects import by_approach
from gapbridge.core.errors import ExcitationError
from gapbridge.core.estimation.identification import Identification, identify_compliance
from gapbridge.core.estimation.streamed import identify_streamed
from gapbridge.core.fitted_range import merged, range_of
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology


@click.command()
@logs_argument
@cell_option
@remounted_option
@click.option("--out", required=True, type=FILE, help="The new cell file to write.")
def fit(logs: tuple[Path, ...], cell: Path, remounted: bool, out: Path) -> None:
    """Identify the compliance of a cell from a log, or from several sessions of one arm.

    Least squares on measured TCP poses (measured_position, and measured_rotation if the log has it)
    under different payloads or forces. Effects of the cell are kept. Writes NEW_CELL: the same cell
    with the identified flexibilities; those that the log does not determine keep the value of the
    cell, and are reported. If the instrument is not registered, its frame and the tool point are
    estimated too; the tool point is written where the log determines it (not with --remounted).
    Where the poses are likelier with them, so are links and joints' zeros (or a registered cell's
    tool point alone, which is written): no flexibility makes up for them, and diagnose names them.
    Links are not written; where the cell would then predict unseen poses worse, they are held
    nominal.
    Declines, with the reason, if nothing in the log excites the compliance. A log of more than
    20,000 rows, or a recording of the daemon (.mcap), is read in pieces, so that memory does not
    grow with it. Several logs (or a column session in one) are sessions: each has its own
    instrument frame, with --remounted also its own tool point, and all share the flexibilities.

    Example: gapbridge fit log.csv --cell cell.yaml --out calibrated.yaml
    """
    given = open_cell(cell)
    require_writable(out, *logs, cell)
    metrology = replace(given.metrology, remounted=remounted)
    try:
        found, wrong, ranges = _identified(logs, given, metrology)
    except ExcitationError as error:
        raise ExcitationError(f"{', '.join(map(str, logs))}: {error}") from None
    spread = Spread.of_fit(found.identifiable, found.covariance).beside(given.spread)
    intervals = given.intervals | fit_intervals(found)
    origin = fitted(provenance({"log": logs, "cell": [cell]}), ranges, spread, intervals)
    save_cell(given, out, found.cell_model, {"provenance": origin})
    for line in wrong:
        click.echo(f"warning: {', '.join(map(str, logs))}: {line}", err=True)
    print_identification(found)
    click.echo(f"{out}: written")


def _identified(
    paths: Sequence[Path], cell: Cell, metrology: Metrology
) -> tuple[Identification, list[str], dict[str, tuple[float, float]]]:
    """Return what the logs show, what is odd in them, and the ranges fitted on.

    One of many rows passes in pieces.
    """
    if (
        len(paths) == 1
        and is_large(paths[0])
        and not (has_sessions(paths[0]) or metrology.remounted)
    ):
        ranges: list[dict[str, tuple[float, float]]] = []
        wrong: list[str] = []

        def read_once() -> Iterator[Log]:
            for piece in LargeLog(paths[0], cell, by_approach(cell.model.terms)):
                if not ranges:
                    wrong.extend(pose_findings(cell, piece))
                ranges.append(range_of(piece))
                yield piece

        with status("fitting") as emit:
            found = identify_streamed(cell.model, read_once(), metrology, progress=emit)
        return found, wrong, merged(ranges)
    rows = open_logs(paths, cell)
    with progress("fitting"):
        found = identify_compliance(cell.model, rows, metrology)
    return found, pose_findings(cell, rows), range_of(rows)


def print_identification(found: Identification) -> None:
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
        f"gap over {found.samples} poses, mm rms per coordinate (in space): "
        f"{_change(found.gap_rms, found.remaining_rms)}"
    )
    if np.isfinite(found.remaining_rms_held_out):
        change = _change(found.gap_rms_held_out, found.remaining_rms_held_out)
        click.echo(f"on poses left out of the fit: {change}")
    for where, left in (
        ("a new region of joint space", found.remaining_rms_new_region),
        ("a new session", found.remaining_rms_new_session),
    ):
        if np.isfinite(left):
            click.echo(f"to expect in {where}, mm rms per coordinate (in space): {_mm(left)}")
    for line in note_texts((*found.notes, *found.combinations)):
        click.echo(f"note: {line}")


def _change(before: float, after: float) -> str:
    return f"{_mm(before)} before, {_mm(after)} after"


def _mm(rms: float) -> str:
    """Return an rms per coordinate (m) in mm, beside it that of the distance in space."""
    return f"{rms * 1e3:.4f} ({3**0.5 * rms * 1e3:.4f})"


def _cells(value: float, std: float, shown: bool) -> tuple[str, str]:
    return f"{value * 1e6:.4f}", f"{std * 1e6:.4f}" if shown else "not identifiable"
