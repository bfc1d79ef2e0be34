"""``gapbridge simulate``."""

from __future__ import annotations

import signal
from pathlib import Path

import click

from gapbridge.bridge.cell.simulation import serve_cell
from gapbridge.bridge.cli.options import cell_argument, open_cell
from gapbridge.drivers.clock import SYSTEM


@click.command()
@cell_argument
@click.option("--host", help="Loopback address to serve at, instead of the cell's.")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the hidden plant.")
def simulate(cell: Path, host: str | None, seed: int | None) -> None:
    """Run a simulated controller for a cell, on its real protocol, until stopped.

    The simulated arm bends with hidden flexibilities that are drawn from the seed. A control port
    (30100) acts as the operator and the laser tracker: `measure`, `payload`, `wrench`,
    `help`. Ends on SIGINT and SIGTERM.

    Example: gapbridge simulate cell.yaml
    """
    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda n, _: stopped.append(n))
    serve_cell(open_cell(cell), host, seed, lambda: bool(stopped), click.echo, SYSTEM)
