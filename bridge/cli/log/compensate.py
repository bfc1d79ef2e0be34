"""``gapbridge compensate``."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from gapbridge.bridge.cell.opened_log import open_log
from gapbridge.bridge.cli.options import (
    cell_option,
    csv_option,
    log_argument,
    open_cell,
    warn_outside,
)
from gapbridge.bridge.cli.progress import progress
from gapbridge.bridge.document.output_file import require_writable, write_table
from gapbridge.core.compensation import correct
from gapbridge.core.errors import InputError
from gapbridge.core.model import Array

CHUNK = 500  # rows between two looks of the progress bar
MISSED = 1e-6  # m: a corrected setpoint that leaves more than this is told


@click.command()
@log_argument
@cell_option
@csv_option
def compensate(log: Path, cell: Path, out: Path) -> None:
    """Correct the setpoint of every row of a log.

    Setpoints come from target_q (where there is none, from actual_q). The wanted pose is the rigid,
    effect-free arm's at the setpoint; the corrected setpoint is the one whose predicted real pose
    is that. Writes corrected_q_0..n-1 (rad).

    Example: gapbridge compensate log.csv --cell cell.yaml --out corrected.csv
    """
    given = open_cell(cell)
    rows = open_log(log, given)
    warn_outside(rows, given)
    require_writable(out, log, cell)
    nominal = rows.require("target_q", "actual_q")
    loads = rows.loads()
    corrected, residual = np.empty(nominal.shape), np.empty(len(nominal))
    with progress("correcting", len(nominal)) as advance:
        for start in range(0, len(nominal), CHUNK):
            part = slice(start, start + CHUNK)
            result = correct(given.model, nominal[part], loads[part])
            corrected[part], residual[part] = result.q, result.residual
            advance(len(result.q))
    _tell_missed(log, residual, rows.first_row)
    write_table(out, [f"corrected_q_{i}" for i in range(given.arm.n)], corrected)
    click.echo(f"{out}: {len(nominal)} corrected setpoints")


def _tell_missed(log: Path, residual: Array, first_row: int) -> None:
    """Refuse rows without an equilibrium; name those whose wanted pose is out of reach."""
    lost = np.flatnonzero(~np.isfinite(residual))
    if len(lost):
        raise InputError(
            f"{log}: row {lost[0] + first_row}: the arm finds no equilibrium under its load; "
            "expected smaller flexibilities or loads"
        )
    missed = np.flatnonzero(residual > MISSED)
    if len(missed):
        worst = missed[np.argmax(residual[missed])]
        click.echo(
            f"warning: {log}: {len(missed)} row(s) cannot reach their wanted pose; row "
            f"{worst + first_row} misses it most, by {residual[worst] * 1e3:.3g} mm",
            err=True,
        )
