"""``gapbridge calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from gapbridge.bridge.calibration.instruments.choice import instrument_settings
from gapbridge.bridge.cli.options import cell_argument, open_cell
from gapbridge.bridge.document.output_file import require_writable

EPILOG = """\b
At every question:
  Enter   go on: it is mounted, the arm stands there, measure
  undo    take the last reading back and measure that pose again
  back    measure an earlier pose again: has the instrument or the target moved?
  moved   the instrument stands elsewhere from now on
  slipped the target sits elsewhere on the tool from now on
  skip    leave this pose out
  note    write a note into the journal: note TEXT
  quit    end here; the same command goes on later
  ?       these words
"""


@click.command(epilog=EPILOG)
@cell_argument
@click.option(
    "--session",
    "folder",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Folder of the session; default: the cell's last one that is not finished, or a new one.",
)
@click.option(
    "--instrument",
    metavar="KIND[,KEY=VALUE...]",
    help="Measure with this instead of the cell's calibration.instrument.",
)
@click.option("--poses", type=click.IntRange(min=6), help="Poses to fit, instead of the cell's.")
@click.option("--plan-only", is_flag=True, help="Plan, say what n poses buy, and end.")
@click.option(
    "--move", is_flag=True, help="Drive the arm, after a yes for each load; default: you jog it."
)
@click.option(
    "--apply",
    "new_cell",
    type=click.Path(path_type=Path),
    metavar="NEW_CELL",
    help="Where the calibrated cell is written, once you say yes; the old one is kept.",
)
@click.option("--verify", is_flag=True, help="Measure a few poses: does the calibration hold?")
@click.option(
    "--payload-only",
    is_flag=True,
    help="Find mass and centre of what the arm carries, and the bias of its sensor.",
)
@click.option(
    "--tool-only", is_flag=True, help="Find the tip of a new tool, brought onto one fixed point."
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
    """Lead a field calibration session; it can be resumed.

    From an unknown arm to a cell that compensates: plans the poses, says what to mount and where to
    put the arm, waits until it stands, reads the instrument, checks each reading at once, and keeps
    it on disk before the next step; the same command goes on after a break, a power cut or Ctrl-C.
    At the end it fits, verifies on poses that the fit did not see, writes a report, and asks before
    it writes a new cell. The arm moves only with --move, and then only after a yes for each load.

    Section `calibration` of the cell says which instrument and loads there are.

    Example: gapbridge calibrate cell.yaml --plan-only

    Example: gapbridge calibrate cell.yaml --session tuesday --apply calibrated.yaml

    Example: gapbridge calibrate cell.yaml --instrument typed,unit=mm --poses 20
    """
    given = open_cell(cell)
    if verify + payload_only + tool_only > 1:
        raise click.UsageError("found more than one of --verify, --payload-only and --tool-only")
    folder, new_cell = options["folder"], options["new_cell"]
    if folder is not None and folder.exists() and not folder.is_dir():
        raise click.UsageError(f"{folder}: found a file, expected a folder for --session")
    if new_cell is not None:
        require_writable(new_cell, cell)
    chosen = instrument_settings(given, instrument)
    from gapbridge.bridge.calibration.options import SessionOptions
    from gapbridge.bridge.calibration.run import run_session  # takes the numerical libraries along

    kind = "verify" if verify else "payload" if payload_only else "tool" if tool_only else "whole"
    run_session(given, SessionOptions(kind=kind, instrument=chosen, **options))
