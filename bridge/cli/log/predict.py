"""``gapbridge predict``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np

from gapbridge.bridge.api.functions import predict as predicted
from gapbridge.bridge.api.records import Predicted
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.opened_log import open_log
from gapbridge.bridge.cli.options import (
    cell_option,
    csv_option,
    log_argument,
    open_cell,
    warn_outside,
)
from gapbridge.bridge.document.output_file import require_writable, write_table
from gapbridge.core.log.log import Log

SHOWN = 8  # rows named at most


@click.command()
@log_argument
@cell_option
@csv_option
@click.option(
    "--channels", is_flag=True, help="Predict joint torques, wrench and encoders as well."
)
def predict(log: Path, cell: Path, out: Path, channels: bool) -> None:
    """Predict the TCP pose of every row of a log.

    Joints come from actual_q (where there is none, from target_q, less what the servos are known to
    give way), loads from the payload,
    payload_cog, actual_TCP_force, joint_temperatures and approach columns. Writes
    predicted_position_0..2 (m) and predicted_rotation_0..2 (rotation vector, rad), in base.

    Where the cell keeps what was fitted (written by fit, calibrate and --apply): its standard
    deviation predicted_position_std_0..2 (m, base axes: the parameters' part, without noise and
    without what no effect explains), and outside_fitted, 1 in rows outside the joints, loads and
    temperatures that were fitted. With --channels also predicted_torque_0..n-1 (Nm, beside
    actual_current_as_torque), predicted_wrench_0..5 (N, Nm, beside ft_raw_wrench) and
    predicted_q_0..n-1 (rad, beside actual_q); nan where a row has no acceleration.

    Example: gapbridge predict log.csv --cell cell.yaml --out predicted.csv
    """
    given = open_cell(cell)
    rows = open_log(log, given)
    warn_outside(rows, given)
    require_writable(out, log, cell)
    found = predicted(given, rows, channels=channels)
    names: list[str] = []
    for name, values in found.columns.items():
        names += [name] if values.ndim == 1 else [f"{name}_{i}" for i in range(values.shape[1])]
    write_table(out, names, np.column_stack(list(found.columns.values())))
    click.echo(f"{out}: {len(rows)} predicted poses")
    for text in _said(given, rows, found):
        click.echo(text)


def _said(cell: Cell, log: Log, found: Predicted) -> Iterator[str]:
    """Yield what is to be known of the predictions: their spread, and what is not there."""
    if found.position_std is None:
        yield f"no standard deviation: {cell.path} keeps no covariance of a fit"
    else:
        std = 1e3 * np.linalg.norm(found.position_std, axis=1)
        yield (
            f"standard deviation of the position (3D, the fit's part): {np.median(std):.4f} mm in "
            f"the middle, at most {std.max():.4f} mm (row {log.line(int(std.argmax()))})"
        )
    if found.outside is not None and found.outside.any():
        rows = np.flatnonzero(found.outside)
        some = ", ".join(str(log.line(i)) for i in rows[:SHOWN]) + (
            ", ..." if len(rows) > SHOWN else ""
        )
        yield f"outside what was fitted: {len(rows)} of {len(found.outside)} rows ({some})"
    for channel, needs in found.lacking.items():
        yield f"no {channel} predicted: needs {needs}"
