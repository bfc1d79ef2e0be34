"""``gapbridge compensate``."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from gapbridge.bridge.api.functions import compensate as corrected
from gapbridge.bridge.cli.log.large_log import pieces_of
from gapbridge.bridge.cli.options import (
    cell_option,
    csv_option,
    log_argument,
    looked_over,
    open_cell,
)
from gapbridge.bridge.cli.progress import progress
from gapbridge.bridge.document.output_file import require_table, writing_table

MISSED = 1e-6  # m: a corrected setpoint that leaves more than this is reported


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
    given = open_cell(cell)
    require_table(out, log, cell)
    names = [f"corrected_q_{i}" for i in range(given.arm.n)]
    rows, missed, worst, line = 0, 0, 0.0, 0
    with writing_table(out) as append, progress("correcting") as advance:
        for piece in looked_over(pieces_of(log, given), given):
            found = corrected(given, piece)
            append(names, found.q)
            missed += int(np.sum(found.residual > MISSED))
            most = int(found.residual.argmax())
            if found.residual[most] > worst:
                worst, line = float(found.residual[most]), piece.line(most)
            rows += len(piece)
            advance(len(piece))
    if missed:
        click.echo(
            f"warning: {log}: {missed} row(s) cannot reach their wanted pose; row {line} misses it "
            f"most, by {worst * 1e3:.3g} mm",
            err=True,
        )
    click.echo(f"{out}: {rows} corrected setpoints")
