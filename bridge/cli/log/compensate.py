"""``gapbridge compensate``."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from gapbridge.bridge.api.functions import compensate as compensate_log
from gapbridge.bridge.cli.log.large_log import pieces_of
from gapbridge.bridge.cli.options import (
    cell_option,
    csv_option,
    log_argument,
    open_cell,
    with_range_warning,
)
from gapbridge.bridge.cli.progress import progress
from gapbridge.bridge.document.output_file import require_table, writing_table

MAX_RESIDUAL = 1e-6  # m from the intended pose, above which a row is reported


@click.command()
@log_argument
@cell_option
@csv_option
def compensate(log: Path, cell: Path, out: Path) -> None:
    """Correct the setpoint of every row of a log.

    Setpoints are taken from target_q (if missing, from actual_q). The intended pose is that of the
    rigid arm without effects at the setpoint; the corrected setpoint is the one whose predicted
    real pose equals it. Writes corrected_q_0..n-1 (rad).

    Example: gapbridge compensate log.csv --cell cell.yaml --out corrected.csv
    """
    opened = open_cell(cell)
    require_table(out, log, cell)
    names = [f"corrected_q_{i}" for i in range(opened.arm.n)]
    rows, missed, worst, line = 0, 0, 0.0, 0
    with writing_table(out) as append, progress("correcting") as advance:
        for piece in with_range_warning(pieces_of(log, opened), opened):
            corrected = compensate_log(opened, piece)
            append(names, corrected.q)
            missed += int(np.sum(corrected.residual > MAX_RESIDUAL))
            most = int(corrected.residual.argmax())
            if corrected.residual[most] > worst:
                worst, line = float(corrected.residual[most]), piece.line(most)
            rows += len(piece)
            advance(len(piece))
    if missed:
        click.echo(
            f"warning: {log}: {missed} row(s) cannot reach their wanted pose; row {line} misses it "
            f"most, by {worst * 1e3:.3g} mm",
            err=True,
        )
    click.echo(f"{out}: {rows} corrected setpoints")
