"""``gapbridge predict``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

import click
import numpy as np

from gapbridge.bridge.api.functions import predict as predict_log
from gapbridge.bridge.api.records import Predicted
from gapbridge.bridge.cell import Cell
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
from gapbridge.core.log.columns import as_table
from gapbridge.core.log.log import Log
from gapbridge.core.predicted_channels import predicted_channels, with_neighbours

MAX_SHOWN = 8  # rows listed


@click.command()
@log_argument
@cell_option
@csv_option
@click.option(
    "--channels", is_flag=True, help="Predict joint torques, wrench and encoders as well."
)
def predict(log: Path, cell: Path, out: Path, channels: bool) -> None:
    """Predict the TCP pose of every row of a log.

    Joints are taken from actual_q (if missing, from target_q minus the droop of the servos), loads
    from the columns payload, payload_cog, actual_TCP_force, joint_temperatures and approach. Writes
    predicted_position_0..2 (m) and predicted_rotation_0..2 (rotation vector, rad), in base.

    If the cell was written by fit, calibrate or --apply, also writes the standard deviation
    predicted_position_std_0..2 (m, base axes: due to the parameters, without noise and unexplained
    errors) and outside_fitted (1 in rows outside the joints, loads and temperatures of the fit).
    With --channels also predicted_torque_0..n-1 (Nm, as actual_current_as_torque),
    predicted_wrench_0..5 (N, Nm, as ft_raw_wrench) and predicted_q_0..n-1 (rad, as actual_q); nan
    in rows without acceleration.

    Example: gapbridge predict log.csv --cell cell.yaml --out predicted.csv
    """
    opened = open_cell(cell)
    require_table(out, log, cell)
    summary = _Summary()
    with writing_table(out) as append, progress("predicting") as advance:
        for piece, predicted in _predicted_pieces(opened, log, channels):
            append(*as_table(predicted.columns))
            summary.add(piece, predicted)
            advance(len(piece))
    click.echo(f"{out}: {summary.rows} predicted poses")
    for text in summary.lines(opened):
        click.echo(text)


def _predicted_pieces(cell: Cell, log: Path, channels: bool) -> Iterator[tuple[Log, Predicted]]:
    """Yield the pieces of a log with their predictions."""
    pieces = with_range_warning(with_log_warnings(pieces_of(log, cell)), cell)
    if not channels:
        yield from ((piece, predict_log(cell, piece)) for piece in pieces)
        return
    for context, rows in with_neighbours(pieces):
        piece = context.select(rows)
        channels_of_context, needs = predicted_channels(cell.model, context)
        further = {name: values[rows] for name, values in channels_of_context.items()}
        yield piece, replace(predict_log(cell, piece), channels=further, needs=needs)


class _Summary:
    """Standard deviation, rows outside the fit and missing channels over all pieces."""

    def __init__(self) -> None:
        self.rows = 0
        self._std: list[Array] = []  # mm, in space
        self._worst = (-1.0, 0)  # mm, line
        self._outside: list[int] = []  # lines of the first
        self._count = 0
        self._needs: dict[str, str] = {}

    def add(self, log: Log, predicted: Predicted) -> None:
        self.rows += len(log)
        if predicted.position_std is not None:
            std = 1e3 * np.linalg.norm(predicted.position_std, axis=1)
            self._std.append(std)
            worst = int(std.argmax())
            self._worst = max(self._worst, (float(std[worst]), log.line(worst)), key=itemgetter(0))
        if predicted.outside is not None:
            rows = np.flatnonzero(predicted.outside)
            self._count += len(rows)
            self._outside += [log.line(i) for i in rows[: MAX_SHOWN - len(self._outside)]]
        self._needs |= predicted.needs

    def lines(self, cell: Cell) -> Iterator[str]:
        """Yield the lines of the summary."""
        if not self._std:
            yield f"no standard deviation: {cell.path} keeps no covariance of a fit"
        else:
            worst, line = self._worst
            median = np.median(np.concatenate(self._std))
            yield (
                f"standard deviation of the position (3D, the fit's part): median "
                f"{median:.4f} mm, at most {worst:.4f} mm (row {line})"
            )
        if self._count:
            rows = ", ".join(map(str, self._outside)) + (", ..." if self._count > MAX_SHOWN else "")
            yield f"outside what was fitted: {self._count} of {self.rows} rows ({rows})"
        for channel, needed in self._needs.items():
            yield f"no {channel} predicted: needs {needed}"
