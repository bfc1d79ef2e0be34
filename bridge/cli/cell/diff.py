"""``gapbridge diff``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import numpy as np

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.difference import Change, Moved, changes, moved
from gapbridge.bridge.cell.opened_log import open_log
from gapbridge.bridge.cli.options import open_cell


@click.command()
@click.argument("before", type=click.Path(path_type=Path))
@click.argument("after", type=click.Path(path_type=Path))
@click.option(
    "--log", type=click.Path(path_type=Path), help="Compare over its poses and loads instead."
)
@click.option("--seed", type=click.IntRange(min=0), default=0, help="Of the random poses.")
@click.option("--json", "as_json", is_flag=True, help="As JSON, SI units.")
def diff(before: Path, after: Path, log: Path | None, seed: int, as_json: bool) -> None:
    """Say what changed from one cell to another: its keys, and millimetres over the workspace.

    The predicted TCP is compared over 200 random poses within the joint limits, under each cell's
    own payload, or over the poses and loads of a log.

    Example: gapbridge diff cell.yaml calibrated.yaml
    """
    one, other = open_cell(before), open_cell(after)
    found = changes(one, other)
    rows = None if log is None else open_log(log, one)
    q = None if rows is None else rows.require("actual_q", "target_q")
    shift = moved(one, other, q, None if rows is None else rows.loads(), seed)
    if as_json:
        told = {"changes": [vars(change) for change in found],
                "moved": None if shift is None else shift.to_json()}  # fmt: skip
        click.echo(json.dumps(told, indent=1))
        return
    if not found:
        click.echo("no key differs")
    for change in found:
        click.echo(_line(change))
    _tell_origin(other)
    click.echo(_in_space(shift, "the log" if log else "the workspace"))


def _line(change: Change) -> str:
    if change.before is None:
        return f"{change.key}: added, {_text(change.after)}"
    if change.after is None:
        return f"{change.key}: removed, was {_text(change.before)}"
    return f"{change.key}: {_text(change.before)} -> {_text(change.after)}"


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return "[" + ", ".join(_text(item) for item in value) + "]"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_text(item)}" for key, item in value.items() if item is not None)
    return str(value)


def _tell_origin(cell: Cell) -> None:
    origin = cell.file.provenance
    if origin is not None and origin.command:
        logs = ", ".join(file.name for file in origin.files if file.role == "log")
        click.echo(
            f"{cell.path} was written by {origin.command}, {origin.time}, version {origin.version}"
            + (f", from {logs}" if logs else "")
        )


def _in_space(shift: Moved | None, over: str) -> str:
    if shift is None:
        return "the predicted TCP cannot be compared: the arms have other joints, or no equilibrium"
    if shift.largest < 1e-9 and shift.turned < 1e-9:
        return f"over {shift.poses} poses of {over} the predicted TCP is the same"
    pose = ", ".join(f"{np.degrees(angle):.0f}" for angle in shift.where)
    mean = ", ".join(f"{1e3 * v:+.3f}" for v in shift.mean)
    return (
        f"over {shift.poses} poses of {over} the predicted TCP moves by {1e3 * shift.rms:.3f} mm "
        f"rms, at most {1e3 * shift.largest:.3f} mm (joints at {pose} degrees) and "
        f"{1e3 * shift.turned:.3f} mrad; on average by [{mean}] mm in base"
    )
