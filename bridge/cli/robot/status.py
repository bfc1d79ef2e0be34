"""``gapbridge status``."""

from __future__ import annotations

import json
from pathlib import Path

import click

from gapbridge.bridge.cli.options import FILE
from gapbridge.bridge.daemon.status_document import lines
from gapbridge.bridge.ipc.control_client import ask, running


@click.command()
@click.argument("cell", type=FILE, required=False)
@click.option("--json", "as_json", is_flag=True, help="Print the whole status document.")
def status(cell: Path | None, as_json: bool) -> None:
    """Show what the daemon of a cell does; without CELL, all daemons of this user.

    Example: gapbridge status cell.yaml --json
    """
    found = running() if cell is None else [ask(cell, "status")]
    if as_json:
        click.echo(json.dumps(found if cell is None else found[0], indent=1))
    elif not found:
        click.echo("no daemon is running")
    for document in [] if as_json else found:
        click.echo("\n".join(lines(document)))
