"""``gapbridge arm`` and ``gapbridge disarm``."""

from __future__ import annotations

from pathlib import Path

import click

from gapbridge.bridge.cli.options import cell_argument
from gapbridge.bridge.ipc.control_client import ask


@click.command()
@cell_argument
def arm(cell: Path) -> None:
    """Make the daemon of a cell write setpoints, and wait until it does.

    Uses a local socket that only the daemon's own user can open; never the network.

    Example: gapbridge arm cell.yaml
    """
    click.echo(ask(cell, "arm"))


@click.command()
@cell_argument
def disarm(cell: Path) -> None:
    """Make the daemon of a cell ramp out and observe; in a fault, acknowledge it.

    Example: gapbridge disarm cell.yaml
    """
    click.echo(ask(cell, "disarm"))
