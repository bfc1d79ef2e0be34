"""``gapbridge calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from gapbridge.bridge.calibration.instruments import instrument_settings
from gapbridge.bridge.calibration.session.prompt import COMMANDS, ENTER, HELP
from gapbridge.bridge.cli.options import FILE, cell_argument, open_cell
from gapbridge.bridge.document.output_file import require_cell

EPILOG = "\b\nAt every question:\n" + "\n".join(
    f"  {name:<8}{text}" for name, text in [("Enter", ENTER), *COMMANDS.items(), ("?", HELP)]
)


@click.command(epilog=EPILOG)
@cell_argument
@click.option(
    "--session",
    "folder",
    type=FILE,
    metavar="DIR",
    help="Folder of the session; default: the cell's last one that is not finished, or a new one.",
)
@click.option(
    "--instrument",
    metavar="KIND[,KEY=VALUE...]",
    help="Measure with this instead of the cell's calibration.instrument.",
)
@click.option(
    "--poses", type=click.IntRange(min=6), help="Number of poses to fit, instead of the cell's."
)
@click.option("--plan-only", is_flag=True, help="Plan, report the expected accuracy, and exit.")
@click.option(
    "--move",
    is_flag=True,
    help="Move the arm, after a confirmation for each load; default: you jog it.",
)
@click.option(
    "--apply",
    "new_cell",
    type=FILE,
    metavar="NEW_CELL",
    help="Where to write the calibrated cell, after confirmation; the old one is kept.",
)
@click.option(
    "--verify",
    is_flag=True,
    help="Measure a few poses to verify that the calibration is still valid; if not, exit with 1, "
    "and the daemon does not arm.",
)
@click.option(
    "--payload-only",
    is_flag=True,
    help="Identify mass and centre of gravity of the payload, and the bias of the sensor.",
)
@click.option(
    "--tool-only", is_flag=True, help="Identify the TCP of a new tool by touching one fixed point."
)
@click.option("--yes", is_flag=True, help="Write the new cell without asking. Never moves the arm.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True,
              help="Seed of the plan.")  # fmt: skip
def calibrate(
    cell: Path,
    instrument: str | None,
    verify: bool,
    payload_only: bool,
    tool_only: bool,
    **options: Any,
) -> None:
    """Run a guided calibration session; it can be resumed.

    Plans the poses, says what to mount and where to move the arm, waits until it rests, reads the
    instrument, checks each reading at once, and saves it before the next step. After a power
    failure or Ctrl-C, rerun the command to resume. At the end it fits, verifies the result on
    poses not used in the fit, writes a report, and asks before it writes a new cell. The arm moves
    only with --move, and then only after a confirmation for each load.

    The section `calibration` of the cell defines the instrument and the loads.

    Example: gapbridge calibrate cell.yaml --plan-only

    Example: gapbridge calibrate cell.yaml --session tuesday --apply calibrated.yaml

    Example: gapbridge calibrate cell.yaml --instrument typed,unit=mm --poses 20
    """
    opened = open_cell(cell)
    if verify + payload_only + tool_only > 1:
        raise click.UsageError("found more than one of --verify, --payload-only and --tool-only")
    folder, new_cell = options["folder"], options["new_cell"]
    if folder is not None and folder.exists() and not folder.is_dir():
        raise click.UsageError(f"{folder}: found a file, expected a folder for --session")
    if new_cell is not None:
        require_cell(new_cell, cell)
    chosen = instrument_settings(opened, instrument)
    from gapbridge.bridge.calibration.options import SessionOptions
    from gapbridge.bridge.calibration.run import run_session  # imports the numerical libraries

    kind = "verify" if verify else "payload" if payload_only else "tool" if tool_only else "whole"
    run_session(opened, SessionOptions(kind=kind, instrument=chosen, **options))
