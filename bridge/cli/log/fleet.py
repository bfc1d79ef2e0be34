"""``gapbridge fleet``: many arms, many sessions."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from gapbridge.bridge.cli.options import FILE, require_effects
from gapbridge.bridge.cli.progress import progress
from gapbridge.bridge.document.output_file import require_folder, require_writable
from gapbridge.bridge.fleet.cell_source import cell_source
from gapbridge.bridge.fleet.journal import Journal
from gapbridge.bridge.fleet.runner import FleetRun, make_tasks, run, summary_lines
from gapbridge.bridge.fleet.session import (
    CELL_TABLE,
    REPORT_FILE,
    RESULTS_FILE,
    SESSIONS_FILE,
    Fleet,
    find_sessions,
)
from gapbridge.bridge.fleet.session_work import diagnose_session, fit_session
from gapbridge.bridge.fleet.task import BAD, DONE, Outcome, SessionJob
from gapbridge.bridge.fleet.workers.dask_workers import DaskWorkers
from gapbridge.bridge.fleet.workers.local_workers import LocalWorkers
from gapbridge.bridge.fleet.workers.workers import Workers
from gapbridge.core.errors import InputError, RunError
from gapbridge.drivers.clock import SYSTEM


@click.group()
def fleet() -> None:
    """Diagnose or fit many arms over many sessions.

    Example: gapbridge fleet diagnose logs --cell cell.yaml --out out/fleet
    """


def shared_options(out: Path) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that adds the options of both commands; results go to ``out``."""
    options = (
        click.argument("logs", nargs=-1, required=True, metavar="DIR_OR_GLOB..."),
        click.option(
            "--cell", required=True, metavar="CELL",
            help="The cell of all logs; or a table (.csv) of columns arm and cell; or the word "
            "'beside': the cell named like the log, or cell.yaml, in the log's folder or above.",
        ),
        click.option(
            "--arm", "pattern", metavar="REGEX",
            help="Matches the arm's name in a log's path below DIR. Default: the first folder, "
            "or the file's name up to its first underscore.",
        ),
        click.option(
            "--out", type=FILE, default=out, show_default=True,
            metavar="DIR", help="Folder of the results; an interrupted run is resumed there.",
        ),
        click.option("--fresh", is_flag=True, help="Start over, ignoring earlier results."),
        click.option(
            "--workers", type=click.IntRange(1), metavar="N", default=None,
            help="Local processes.  [default: one a processor]",
        ),
        click.option(
            "--scheduler", metavar="ADDRESS",
            help="Use the Dask cluster of this scheduler instead, such as tcp://10.0.0.5:8786.",
        ),
    )  # fmt: skip

    def added(command: Callable[..., None]) -> Callable[..., None]:
        for option in reversed(options):
            command = option(command)
        return command

    return added


@dataclass(frozen=True)
class FleetOptions:
    """The values of the options that both commands share."""

    logs: tuple[str, ...]
    cell: str
    pattern: str | None
    out: Path
    fresh: bool
    workers: int | None
    scheduler: str | None
    cells: Path | None = None  # folder of the new cells

    def tables(self) -> list[Path]:
        """Return the tables that a run reads or writes, which may be in a folder of its logs."""
        written = [self.out / RESULTS_FILE, self.out / SESSIONS_FILE, Path(self.cell)]
        return written if self.cells is None else [*written, self.cells / CELL_TABLE]


@fleet.command()
@shared_options(Path("out/fleet"))
@click.option(
    "--withhold", multiple=True, metavar="EFFECT", help="Remove an effect from the catalogue."
)
def diagnose(withhold: tuple[str, ...], **values: Any) -> None:
    """Diagnose every log: which effects recur, which arms drift, which are unusual.

    Writes results.parquet (a row per session and parameter), sessions.parquet and report.html. A
    log that cannot be used is reported and skipped. Results are saved as they finish: rerun the
    command to resume.

    Example: gapbridge fleet diagnose 'logs/*/2026-*.csv' --cell arms.csv --workers 8
    """
    require_effects(withhold)
    options = FleetOptions(**values)
    done, sessions = _run("diagnose", diagnose_session, {"withhold": list(withhold)}, options)
    from gapbridge.bridge.fleet.output import write_diagnosis

    _print_results(done, sessions, *write_diagnosis(done, sessions, options.out))


@fleet.command()
@shared_options(Path("out/fit"))
@click.option(
    "--apply", "cells", type=FILE, metavar="DIR",
    help="Write a new cell per arm there, and cells.csv, a table of them."
)  # fmt: skip
def fit(cells: Path | None, **values: Any) -> None:
    """Fit the compliance of all arms together: type, arm, session.

    An arm with few poses benefits from the others of its type where its own data are weak.
    Writes results.parquet, sessions.parquet and report.html.

    Example: gapbridge fleet fit logs --cell beside --out out/fit --apply out/cells
    """
    if cells is not None:
        require_folder(cells, "--apply")
        require_writable(cells / CELL_TABLE)
    options = FleetOptions(**values, cells=cells)
    done, sessions = _run("fit", fit_session, {}, options)
    from gapbridge.bridge.fleet.output import write_fit

    _print_results(done, sessions, *write_fit(done, sessions, options.out, cells))


def _run(
    name: str, job: SessionJob, job_options: Mapping[str, Any], options: FleetOptions
) -> tuple[FleetRun, Fleet]:  # fmt: skip
    """Run a job on all sessions; raises InputError or RunError if none is usable."""
    workers, scheduler = options.workers, options.scheduler
    if workers is not None and scheduler is not None:
        raise InputError("--workers: found beside --scheduler, expected one of them")
    sessions = find_sessions(options.logs, options.pattern, without=options.tables())
    cells = cell_source(options.cell, sessions.folder)
    for warning in cells.warnings():
        click.echo(f"warning: {warning}", err=True)
    require_folder(options.out, "--out")
    for file in (RESULTS_FILE, SESSIONS_FILE, REPORT_FILE):
        require_writable(options.out / file)
    tasks, bad = make_tasks(sessions.sessions, cells, job, job_options)
    if options.cells is not None:
        from gapbridge.bridge.fleet.output import require_no_input

        inputs = (*cells.inputs(), *(task.cell for task in tasks))
        require_no_input(options.cells, [task.arm for task in tasks], inputs)
    count = min(workers or os.cpu_count() or 1, max(len(tasks), 1))
    pool: Workers = DaskWorkers(scheduler) if scheduler else LocalWorkers(count)
    for outcome in bad:
        _print_skipped(outcome)
    with (
        Journal(options.out / f"{name}.jsonl", SYSTEM, fresh=options.fresh) as journal,
        progress(f"{name}: sessions", len(tasks)) as advance,
    ):

        def emit(outcome: Outcome) -> None:
            _print_skipped(outcome)
            advance(1)

        done = run(tasks, bad, pool, journal, emit)
    _require_usable(done)
    return done, sessions


def _print_skipped(outcome: Outcome) -> None:
    if outcome.state != DONE:
        click.echo(f"skipped: {outcome.error}", err=True)


def _require_usable(done: FleetRun) -> None:
    if any(o.state == DONE for o in done.outcomes):
        return
    text = f"found no usable session among {len(done.outcomes)}, expected at least one"
    first = done.outcomes[0].error
    if all(o.state == BAD for o in done.outcomes):
        raise InputError(f"{text}; the first: {first}")
    raise RunError(f"{text}; the first: {first}")


def _print_results(done: FleetRun, sessions: Fleet, lines: list[str], files: list[Path]) -> None:
    for line in (*summary_lines(done, sessions), *lines):
        click.echo(line)
    for file in files:
        click.echo(f"{file}: written")
