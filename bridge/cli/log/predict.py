"""``gapbridge predict``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

import click
import numpy as np

from gapbridge.bridge.api.functions import predict as predicted
from gapbridge.bridge.api.records import Predicted, as_table
from gapbridge.bridge.cell import Cell
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
from gapbridge.core.arrays import Array
from gapbridge.core.log.log import Log
from gapbridge.core.predicted_channels import predicted_channels, with_neighbours

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
    given = open_cell(cell)
    require_table(out, log, cell)
    summary = _Summary()
    with writing_table(out) as append, progress("predicting") as advance:
        for piece, found in _predicted(given, log, channels):
            append(*as_table(found.columns))
            summary.add(piece, found)
            advance(len(piece))
    click.echo(f"{out}: {summary.rows} predicted poses")
    for text in summary.lines(given):
        click.echo(text)


def _predicted(cell: Cell, log: Path, channels: bool) -> Iterator[tuple[Log, Predicted]]:
    """Yield the pieces of a log with what is predicted of them."""
    pieces = looked_over(pieces_of(log, cell), cell)
    if not channels:
        yield from ((piece, predicted(cell, piece)) for piece in pieces)
        return
    for around, own in with_neighbours(pieces):
        piece = around.select(own)
        further, needs = predicted_channels(cell.model, around)
        further = {name: values[own] for name, values in further.items()}
        yield piece, replace(predicted(cell, piece), channels=further, needs=needs)


class _Summary:
    """What is to be known of the predictions of all pieces: their spread, and what is not there."""

    def __init__(self) -> None:
        self.rows = 0
        self._std: list[Array] = []  # mm, in space
        self._worst = (-1.0, 0)  # mm, line
        self._outside: list[int] = []  # lines of the first
        self._count = 0
        self._needs: dict[str, str] = {}

    def add(self, log: Log, found: Predicted) -> None:
        self.rows += len(log)
        if found.position_std is not None:
            std = 1e3 * np.linalg.norm(found.position_std, axis=1)
            self._std.append(std)
            worst = int(std.argmax())
            self._worst = max(self._worst, (float(std[worst]), log.line(worst)), key=itemgetter(0))
        if found.outside is not None:
            rows = np.flatnonzero(found.outside)
            self._count += len(rows)
            self._outside += [log.line(i) for i in rows[: SHOWN - len(self._outside)]]
        self._needs |= found.needs

    def lines(self, cell: Cell) -> Iterator[str]:
        """Yield what a person should know."""
        if not self._std:
            yield f"no standard deviation: {cell.path} keeps no covariance of a fit"
        else:
            worst, line = self._worst
            middle = np.median(np.concatenate(self._std))
            yield (
                f"standard deviation of the position (3D, the fit's part): {middle:.4f} mm in "
                f"the middle, at most {worst:.4f} mm (row {line})"
            )
        if self._count:
            some = ", ".join(map(str, self._outside)) + (", ..." if self._count > SHOWN else "")
            yield f"outside what was fitted: {self._count} of {self.rows} rows ({some})"
        for channel, needed in self._needs.items():
            yield f"no {channel} predicted: needs {needed}"
