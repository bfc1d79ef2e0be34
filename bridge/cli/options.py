"""Arguments that several commands share, and opening of cells and logs.

Readers of cells and logs are imported on use: ``status`` and ``--help`` need none.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from gapbridge.core.errors import InputError

if TYPE_CHECKING:
    from gapbridge.bridge.cell import Cell
    from gapbridge.core.log.log import Log
    from gapbridge.core.log.log_finding import LogFinding

FILE = click.Path(path_type=Path)
log_argument = click.argument("log", type=FILE)
logs_argument = click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=FILE)
remounted_option = click.option(
    "--remounted",
    is_flag=True,
    help="The target was taken off between sessions: each has its own tool point.",
)
cell_argument = click.argument("cell", type=FILE)
cell_option = click.option("--cell", required=True, type=FILE, help="The cell file (YAML).")
csv_option = click.option(
    "--out",
    required=True,
    type=FILE,
    help="The file to write: CSV, or Parquet if it ends in .parquet.",
)


def require_effects(names: Iterable[str]) -> None:
    """Raise InputError for a name of --withhold that is no effect's."""
    from gapbridge.core.effects import effect_named

    for name in names:
        try:
            effect_named(name)
        except InputError as error:
            raise InputError(f"--withhold: {error}") from None


def open_cell(path: Path) -> Cell:
    """Return a cell; its warnings go to stderr."""
    from gapbridge.bridge.cell import load_cell

    cell = load_cell(path)
    for warning in cell.warnings:
        click.echo(f"warning: {warning}", err=True)
    return cell


def open_logs(paths: Sequence[Path], cell: Cell, *, warn: bool) -> Log:
    """Return several logs as the sessions of one; a single log is returned as it is.

    ``warn``: with the warnings of ``with_log_warnings`` on each. Raises LogError as ``open_log``
    does, and if the sessions are inconsistent.
    """
    from gapbridge.bridge.cell.opened_log import open_log
    from gapbridge.core.sessions import join_sessions

    logs = [open_log(path, cell) for path in paths]
    for log in logs if warn else ():
        for _ in with_log_warnings([log]):
            pass
    return join_sessions(logs, cell.model)


def with_log_warnings(pieces: Iterable[Log]) -> Iterator[Log]:
    """Yield the pieces of a log, then print what it misspells and whether its rows lack order."""
    from gapbridge.core.diagnosis.log_checks.units_and_clocks import ColumnsAndOrder

    checked, path = ColumnsAndOrder(), ""
    for piece in pieces:
        checked.add(piece)
        path = piece.path
        yield piece
    _print_warnings(path, checked.findings())


def warn_outside(log: Log, cell: Cell) -> None:
    """Print a warning if poses, loads or temperatures of a log are outside the data of the fit.

    Their range is in the cell's ``provenance``; without it there is no warning.
    """
    for _ in with_range_warning([log], cell):
        pass


def with_range_warning(pieces: Iterable[Log], cell: Cell) -> Iterator[Log]:
    """Yield the pieces of a log, then print the warnings of ``warn_outside`` for all of them."""
    from gapbridge.core.fitted_range import Outside

    outside, path = Outside(cell.fitted_range), ""
    for piece in pieces:
        outside.add(piece)
        path = piece.path
        yield piece
    _print_warnings(path, outside.findings())


def _print_warnings(path: str, findings: Iterable[LogFinding]) -> None:
    from gapbridge.bridge.document.log_findings import log_finding_text

    for finding in findings:
        click.echo(f"warning: {path}: {log_finding_text(finding)}", err=True)
