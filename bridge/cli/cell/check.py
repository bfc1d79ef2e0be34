"""``gapbridge check``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np

from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.bridge.cell.cell import cell_errors
from gapbridge.bridge.cell.live import compare_live
from gapbridge.bridge.cell.log_consistency import log_findings
from gapbridge.bridge.cell.message import located_message, message_at
from gapbridge.bridge.cell.plausibility import Findings
from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.bridge.cell.verification_mark import read_mark
from gapbridge.bridge.cli.options import FILE, cell_argument
from gapbridge.core.calibration.spread import parameters_named
from gapbridge.core.errors import InputError
from gapbridge.drivers.clock import SYSTEM


@click.command()
@cell_argument
@click.option("--live", is_flag=True, help="Compare with the controller too; moves nothing.")
@click.option(
    "--log",
    "logs",
    type=FILE,
    multiple=True,
    metavar="LOG",
    help="Compare with measured poses too: order and signs of joints, DH rows, frames.",
)
def check(cell: Path, live: bool, logs: tuple[Path, ...]) -> None:
    """Check a cell file for mistakes, and report each with its line.

    Checks units by plausible magnitude (m, rad, kg, °C), reach, masses and limits; an impossible
    value is an error, an unusual one a warning. With --live also shows TCP, payload, gravity,
    geometry and rate beside the controller's, and compares them; what arming would refuse is an
    error. With --log also compares the arm with measured poses; if they do not agree, common
    mistakes are tried (modified DH rows, a sign, inches, the order of joints, frames), and the one
    that explains them is reported. Exits with 0 if there is no error, 2 otherwise.

    Example: gapbridge check cell.yaml --live
    """
    errors = cell_errors(cell)
    warnings: list[str] = []
    if not errors:
        opened = load_cell(cell)
        warnings += opened.warnings
        for findings in _further_findings(opened):
            errors += findings.errors
            warnings += findings.warnings
        if live and not errors:
            compared = compare_live(opened, SYSTEM)
            errors += compared.errors
            warnings += compared.warnings
            for line in compared.table:
                click.echo(line)
        for log in logs if not errors else ():
            findings = log_findings(opened, log)
            errors += findings.errors
            warnings += findings.warnings
    for line in warnings:
        click.echo(f"warning: {line}", err=True)
    for line in errors:
        click.echo(f"error: {line}", err=True)
    if errors:
        raise click.exceptions.Exit(2)
    count = f", {len(warnings)} warning{'s' * (len(warnings) != 1)}" if warnings else ""
    beside = [*["its controller"] * live, *map(str, logs)]
    text = f" with {' and '.join(beside)}" if beside else ""
    click.echo(f"{cell}: fit to be used{text}{count}")


def _further_findings(cell: Cell) -> Iterator[Findings]:
    """Yield what only predict, calibrate or run would refuse: loads, names, places, files."""
    if (problem := cell.payload_problem) is not None:
        yield Findings([str(problem)], [])
    try:
        if cell.spread.names:
            parameters_named(cell.model, cell.spread.names, "provenance")
        if "calibration" in cell.document.data:
            from gapbridge.bridge.calibration.planning import check_session

            check_session(cell)
    except InputError as error:
        yield Findings([located_message(cell.document, error)], [])
    if cell.file.link is not None:
        yield _run_findings(cell)
    if reason := read_mark(cell.path):
        way_out = f"expected a verification that passes, or gapbridge disarm {cell.path}"
        yield Findings([f"{reason}; {way_out}"], [])


def _run_findings(cell: Cell) -> Findings:
    """Return the findings in what only a run reads: limits, profiles, tokens, a trajectory."""
    limits = cell.arm.limits
    for i in np.flatnonzero(limits.lower >= limits.upper):
        text = f"joint {i + 1}: found limits {limits.lower[i]:g} to {limits.upper[i]:g} rad"
        line = message_at(cell.document, ("robot",), f"{text}, expected lower below upper")
        return Findings([line], [])
    from gapbridge.bridge.daemon.runnable import require_runnable

    try:
        settings = read_configuration(cell.path).settings
        require_runnable(cell, settings, SYSTEM)
    except InputError as error:
        return Findings([located_message(cell.document, error)], [])
    setpoints, rate = settings.setpoints, settings.link.rate
    if setpoints.source != "trajectory":
        return Findings([], [])
    from gapbridge.bridge.cli.cell.trajectory_check import trajectory_findings

    return trajectory_findings(cell, setpoints, rate)
