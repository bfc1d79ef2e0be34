"""``gapbridge compensate``."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from gapbridge.bridge.api.functions import compensate as compensate_log
from gapbridge.bridge.api.functions import joint_offsets
from gapbridge.bridge.cli.log.large_log import pieces_of
from gapbridge.bridge.cli.options import (
    cell_option,
    csv_option,
    log_argument,
    open_cell,
    with_log_warnings,
    with_range_warning,
)
from gapbridge.bridge.cli.progress import progress
from gapbridge.bridge.document.output_file import require_table, writing_table
from gapbridge.core.arrays import Array
from gapbridge.core.log.log import Log

MAX_RESIDUAL = 1e-6  # m from the intended pose, above which a row is reported


class Exceeded:
    """Rows whose value exceeds a limit: how many, and the line and value of the worst."""

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self.rows, self.line, self.worst = 0, 0, limit

    def take(self, piece: Log, values: Array) -> None:
        """Add the rows of a piece, with their values (N,)."""
        self.rows += int(np.sum(values > self.limit))
        most = int(values.argmax())
        if values[most] > self.worst:
            self.worst, self.line = float(values[most]), piece.line(most)


@click.command()
@log_argument
@cell_option
@csv_option
def compensate(log: Path, cell: Path, out: Path) -> None:
    """Correct the setpoint of every row of a log.

    Setpoints are taken from target_q (if missing, from actual_q). The intended pose is that of the
    rigid arm without effects at the setpoint; the corrected setpoint is the one whose predicted
    real pose equals it. Writes corrected_q_0..n-1 (rad). A row whose correction exceeds
    limits.offset, offset_rotation or joint_offset of the cell, or that misses its intended pose by
    more than limits.offset, is refused; nothing is written then.

    Example: gapbridge compensate log.csv --cell cell.yaml --out corrected.csv
    """
    opened = open_cell(cell)
    require_table(out, log, cell)
    names = [f"corrected_q_{i}" for i in range(opened.arm.n)]
    rows, misses, offsets = 0, Exceeded(MAX_RESIDUAL), Exceeded(opened.limits.joint_offset)
    with writing_table(out) as append, progress("correcting") as advance:
        pieces = with_log_warnings(pieces_of(log, opened))
        for piece in with_range_warning(pieces, opened):
            corrected = compensate_log(opened, piece)
            append(names, corrected.q)
            misses.take(piece, corrected.residual)
            offsets.take(piece, joint_offsets(piece, corrected.q))
            rows += len(piece)
            advance(len(piece))
    if misses.rows:
        click.echo(
            f"warning: {log}: {misses.rows} row(s) miss their wanted pose, near a singular pose or "
            f"beyond reach; row {misses.line} misses it most, by {misses.worst * 1e3:.3g} mm",
            err=True,
        )
    if offsets.rows:
        click.echo(
            f"warning: {log}: {offsets.rows} row(s) near a singular pose need more than "
            f"limits.joint_offset ({offsets.limit:g} rad), the largest that `run` writes; row "
            f"{offsets.line} needs most, {offsets.worst:.3g} rad",
            err=True,
        )
    click.echo(f"{out}: {rows} corrected setpoints")
