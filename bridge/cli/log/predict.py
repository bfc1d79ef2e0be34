"""``gapbridge predict``."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from gapbridge.bridge.api.functions import predict as predicted
from gapbridge.bridge.cell.opened_log import open_log
from gapbridge.bridge.cli.options import (
    cell_option,
    csv_option,
    log_argument,
    open_cell,
    warn_outside,
)
from gapbridge.bridge.document.output_file import require_writable, write_table


@click.command()
@log_argument
@cell_option
@csv_option
def predict(log: Path, cell: Path, out: Path) -> None:
    """Predict the TCP pose of every row of a log.

    Joints come from actual_q (where there is none, from target_q, less what the servos are known to
    give way), loads from the payload,
    payload_cog, actual_TCP_force, joint_temperatures and approach columns. Writes
    predicted_position_0..2 (m) and predicted_rotation_0..2 (rotation vector, rad), in base.

    Example: gapbridge predict log.csv --cell cell.yaml --out predicted.csv
    """
    given = open_cell(cell)
    rows = open_log(log, given)
    warn_outside(rows, given)
    require_writable(out, log, cell)
    found = predicted(given, rows)
    names = [f"predicted_{kind}_{i}" for kind in ("position", "rotation") for i in range(3)]
    write_table(out, names, np.hstack([found.position, found.rotation_vector]))
    click.echo(f"{out}: {len(rows)} predicted poses")
