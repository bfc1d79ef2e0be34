"""``gapbridge fit``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from gapbridge.bridge.api.uncertainty import provenance_of_fit
from gapbridge.bridge.cell import Cell, save_cell
from gapbridge.bridge.cell.log_consistency import pose_warnings
from gapbridge.bridge.cli.log.large_log import LargeLog, has_sessions, is_large
from gapbridge.bridge.cli.options import (
    FILE,
    cell_option,
    logs_argument,
    open_cell,
    open_logs,
    remounted_option,
    with_log_warnings,
)
from gapbridge.bridge.cli.progress import progress, status
from gapbridge.bridge.document.notes import note_texts
from gapbridge.bridge.document.output_file import require_cell
from gapbridge.bridge.document.provenance import provenance
from gapbridge.core.effects import by_approach
from gapbridge.core.errors import ExcitationError
from gapbridge.core.estimation.identification import Identification, identify_compliance
from gapbridge.core.estimation.streamed import identify_streamed
from gapbridge.core.fitted_range import merged, range_of
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology

SHOWN = 1e-7  # m: the last digit of a printed gap


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
    estimated too; the tool point is written if the log determines it (not with --remounted).
    If the poses support them, so are link geometry and joint offsets (of a registered cell the tool
    point alone, which is written), so that they do not bias the flexibilities; diagnose names them.
    Link geometry is not written; if the cell would then predict unseen poses worse, it is kept
    nominal.
    Declines, with the reason, if nothing in the log excites the compliance. A log of more than
    20,000 rows, or a recording of the daemon (.mcap), is read in pieces, so that memory does not
    grow with it. Several logs (or a column session in one) are sessions: each has its own
    instrument frame, with --remounted also its own tool point, and all share the flexibilities.

    Example: gapbridge fit log.csv --cell cell.yaml --out calibrated.yaml
    """
    opened = open_cell(cell)
    require_cell(out, *logs, cell)
    metrology = replace(opened.metrology, remounted=remounted)
    try:
        estimate, warnings, ranges = _identified(logs, opened, metrology)
    except ExcitationError as error:
        raise ExcitationError(f"{', '.join(map(str, logs))}: {error}") from None
    origin = provenance({"log": logs, "cell": [cell]})
    origin = provenance_of_fit(opened, estimate, origin, ranges)
    save_cell(opened, out, estimate.cell_model, {"provenance": origin})
    if estimate.remaining_rms - estimate.gap_rms > SHOWN:
        warnings.append(
            "the fit does not reduce the gap: the log does not show that these flexibilities are "
            "better than the cell's"
        )
    for line in warnings:
        click.echo(f"warning: {', '.join(map(str, logs))}: {line}", err=True)
    print_identification(estimate)
    click.echo(f"{out}: written")


def _identified(
    paths: Sequence[Path], cell: Cell, metrology: Metrology
) -> tuple[Identification, list[str], dict[str, tuple[float, float]]]:
    """Return the estimate, warnings about the logs, and the range of each fitted column.

    A large log is read in pieces.
    """
    if (
        len(paths) == 1
        and is_large(paths[0])
        and not (metrology.remounted or has_sessions(paths[0]))
    ):
        ranges: list[dict[str, tuple[float, float]]] = []
        warnings: list[str] = []

        def read_once() -> Iterator[Log]:
            pieces: Iterable[Log] = LargeLog(paths[0], cell, by_approach(cell.model.terms))
            for piece in pieces if ranges else with_log_warnings(pieces):
                if not ranges:
                    warnings.extend(pose_warnings(cell, piece, metrology))
                ranges.append(range_of(piece))
                yield piece

        with status("fitting") as emit:
            estimate = identify_streamed(cell.model, read_once(), metrology, progress=emit)
        return estimate, warnings, merged(ranges)
    rows = open_logs(paths, cell, warn=True)
    warnings = pose_warnings(cell, rows, metrology)
    with progress("fitting"):
        estimate = identify_compliance(cell.model, rows, metrology)
    return estimate, warnings, range_of(rows)


def print_identification(estimate: Identification) -> None:
    """Print flexibilities with 1 sigma, gaps before and after, expected gaps, and notes."""
    table = Table(title="joint flexibility, 1e-6 rad/Nm", title_justify="left")
    for column in ("joint", "axial", "±", "radial", "±"):
        table.add_column(column, justify="right")
    n = len(estimate.axial)
    for i in range(n):
        table.add_row(
            str(i + 1),
            *_cells(estimate.axial[i], estimate.std_axial[i], bool(estimate.identifiable[i])),
            *_cells(estimate.radial[i], estimate.std_radial[i], bool(estimate.identifiable[n + i])),
        )
    console = Console()
    console.print(table)
    click.echo(
        f"gap over {estimate.samples} poses, mm rms per coordinate (in space): "
        f"{_change(estimate.gap_rms, estimate.remaining_rms)}"
    )
    if np.isfinite(estimate.remaining_rms_held_out):
        change = _change(estimate.gap_rms_held_out, estimate.remaining_rms_held_out)
        click.echo(f"on poses left out of the fit: {change}")
    for where, rms in (
        ("a new region of joint space", estimate.remaining_rms_new_region),
        ("a new session", estimate.remaining_rms_new_session),
    ):
        if np.isfinite(rms):
            click.echo(f"to expect in {where}, mm rms per coordinate (in space): {_mm(rms)}")
    for line in note_texts((*estimate.notes, *estimate.combinations)):
        click.echo(f"note: {line}")


def _change(before: float, after: float) -> str:
    return f"{_mm(before)} before, {_mm(after)} after"


def _mm(rms: float) -> str:
    """Return an rms per coordinate (m) in mm, and in parentheses that of the distance."""
    return f"{rms * 1e3:.4f} ({3**0.5 * rms * 1e3:.4f})"


def _cells(value: float, std: float, shown: bool) -> tuple[str, str]:
    return f"{value * 1e6:.4f}", f"{std * 1e6:.4f}" if shown else "not identifiable"
