"""``gapbridge diagnose``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from gapbridge.bridge import api
from gapbridge.bridge.api.records import REPORT_FILES
from gapbridge.bridge.cell.opened_log import open_log
from gapbridge.bridge.cli.log.diagnosis_text import diagnosis_text, wrong_arm_findings
from gapbridge.bridge.cli.options import (
    FILE,
    cell_option,
    logs_argument,
    open_cell,
    open_logs,
    remounted_option,
    require_effects,
    warn_outside,
)
from gapbridge.bridge.cli.progress import status
from gapbridge.bridge.document.log_findings import log_finding_text
from gapbridge.bridge.document.output_file import require_cell, require_folder, require_writable
from gapbridge.core.errors import InputError


@click.command()
@logs_argument
@cell_option
@remounted_option
@click.option(
    "--out",
    type=FILE,
    metavar="DIR",
    help="Folder for diagnosis.json and report.html; created if missing.",
)
@click.option("--json", "json_file", type=FILE, metavar="FILE", help="Write the diagnosis as JSON.")
@click.option(
    "--apply",
    "new_cell",
    type=FILE,
    metavar="NEW_CELL",
    help="Write the cell with the found effects added.",
)
@click.option(
    "--stand-ins",
    is_flag=True,
    help="With --apply: also what is not proved, but shrinks the gap in regions not fitted.",
)
@click.option(
    "--withhold",
    multiple=True,
    metavar="EFFECT",
    help="Remove an effect from the catalogue; may be given several times.",
)
@click.option(
    "--sim",
    type=FILE,
    metavar="SIM_LOG",
    help="Take the prediction from a log of your own simulator: rows of the same time.",
)
def diagnose(
    logs: tuple[Path, ...],
    cell: Path,
    remounted: bool,
    withhold: tuple[str, ...],
    sim: Path | None,
    **options: Any,
) -> None:
    """Diagnose the sim-to-real gap of a log, or of several sessions of one arm.

    Reports where the gap is, which effects cause it, and how far it shrinks with them in the model.
    A cause is named only if it shrinks the gap on poses not used in its fit; what the catalogue
    does not explain is reported with the quantities it depends on. Several logs (or a column
    session in one) are sessions that share the effects; each has its own instrument frame, with
    --remounted also its own tool point.

    With --sim the prediction is taken from your simulator: a log with the simulated TCP in base as
    measured_position_0..2 or actual_TCP_pose_0..5 (and optionally ft_raw_wrench, actual_q,
    torques), with a row for each row of LOG: matched by timestamp, or else by row number. Rows of
    another pose are refused.

    Example: gapbridge diagnose log.csv --cell cell.yaml --out out/diagnosis --apply better.yaml
    """
    output = _Output(**options)
    if output.stand_ins and output.new_cell is None:
        raise InputError("--stand-ins: found no --apply, expected the cell to write")
    opened = open_cell(cell)
    # joined, they hide what one of them misspells; of a single log the diagnosis reports it
    rows = open_logs(logs, opened, warn=len(logs) > 1)
    warn_outside(rows, opened)
    require_effects(withhold)
    simulated = None if sim is None else open_log(sim, opened)
    output.require_writable(*logs, cell, *([sim] if sim else []))
    with status("diagnosing") as emit:
        found = api.diagnose(
            opened, rows, withhold=withhold, remounted=remounted, simulated=simulated,
            progress=emit,
        )  # fmt: skip
    for finding in wrong_arm_findings(found.diagnosis):
        text = log_finding_text(finding)
        if output.new_cell is not None and (finding.forbids_fit or finding.misread):
            of = f" of {finding.misread}" if finding.misread else ""
            text += f"; no cause{of} is written into the cell"
        click.echo(f"warning: {rows.path}: {text}", err=True)
    written = output.write(found)  # before the text: its reader may leave early
    click.echo(diagnosis_text(found.diagnosis))
    for file in written:
        click.echo(f"{file}: written")


@dataclass(frozen=True)
class _Output:
    """The output files of the command; None: not written."""

    out: Path | None
    json_file: Path | None
    new_cell: Path | None
    stand_ins: bool

    def require_writable(self, *inputs: Path) -> None:
        """Create the folder; raise InputError if a file is not writable, or is an input."""
        files = [file for file in (self.json_file, self.new_cell) if file is not None]
        if self.out is not None:  # first: the other files may be in it
            require_folder(self.out, "--out", above=False)
            files = [*(self.out / name for name in REPORT_FILES), *files]
        for number, file in enumerate(files):
            check = require_cell if file is self.new_cell else require_writable
            check(file, *inputs, *files[:number])

    def write(self, diagnosed: api.Diagnosed) -> list[Path]:
        """Write the requested files and return their paths."""
        if self.json_file is not None:
            diagnosed.write_json(self.json_file)
        if self.new_cell is not None:
            diagnosed.save(self.new_cell, stand_ins=self.stand_ins)
        folder = [] if self.out is None else diagnosed.write_report(self.out)
        return [*folder, *(f for f in (self.json_file, self.new_cell) if f is not None)]
