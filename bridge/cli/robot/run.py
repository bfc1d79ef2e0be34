"""``gapbridge run``."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from gapbridge.bridge.cli.options import cell_argument, open_cell
from gapbridge.bridge.ipc.log_lines import JsonLines
from gapbridge.core.errors import InputError


@click.command()
@cell_argument
@click.option("--observe", is_flag=True, help="Compute and record, but write nothing.")
@click.option("--arm", is_flag=True, help="Write setpoints, whatever the cell says.")
@click.option(
    "--duration",
    type=click.FloatRange(min=0, min_open=True),
    metavar="S",
    help="End after so many seconds; else on SIGINT or SIGTERM.",
)
@click.option(
    "--log",
    type=click.Choice(["text", "json"]),
    default="text",
    show_default=True,
    help="json: every event also as a line of JSON on stderr.",
)
def run(cell: Path, observe: bool, arm: bool, duration: float | None, log: str) -> None:
    """Run the on-cell daemon: read the arm's state, predict how it bends, correct its setpoints.

    Setpoints are written if the cell has `setpoints.arm: true`, with --arm, or after
    `gapbridge arm CELL`. SIGHUP reads the cell file again; SIGTERM, Ctrl-C and a closed terminal
    ramp out and end it.

    Example: gapbridge run cell.yaml --observe --duration 60
    """
    if observe and arm:
        raise InputError("--observe: found beside --arm, expected one of them")
    if duration is not None and not duration < float("inf"):
        raise InputError(f"--duration: found {duration:g}, expected a number of seconds")
    opened = open_cell(cell)
    from gapbridge.bridge.daemon.run import run_cell  # imports the numerical libraries

    json = JsonLines(sys.stderr).emit if log == "json" else None
    if code := run_cell(opened, observe=observe, arm=arm, duration=duration, log=json):
        raise click.exceptions.Exit(code)
