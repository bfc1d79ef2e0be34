"""``gapbridge export``."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import click

from gapbridge.bridge.cli.options import FILE
from gapbridge.bridge.document.notes import note_texts
from gapbridge.bridge.document.output_file import require_cell, require_table, write_text
from gapbridge.bridge.recording.export import Exported, Span, export, moment
from gapbridge.core.errors import InputError
from gapbridge.core.log.mcap_reading import SUFFIX, damages, files_of, read_configuration


@click.command("export")
@click.argument("recording", type=FILE)
@click.option(
    "--out",
    type=FILE,
    help="The log to write, .csv or .parquet; left out: a CSV beside the recording.",
)
@click.option("--from", "start", metavar="T", help="Leave out what was before.")
@click.option("--to", "stop", metavar="T", help="Leave out what was after.")
@click.option("--cell-out", type=FILE, help="Write the cell file that it ran by, too.")
def export_recording(
    recording: Path, out: Path | None, start: str | None, stop: str | None, cell_out: Path | None
) -> None:
    """Convert a recording of the daemon to a log for fit and diagnose.

    RECORDING is one file (run-20260131-140500-001.mcap) or a whole run (run-20260131-140500). T is
    in seconds from the start (negative: before the end) or a time like 2026-01-31T14:05:00. The log
    also has the columns nominal_q, corrected_q, offset (of the TCP in base, m and rad), written and
    state.

    Example: gapbridge export recordings/run-20260131-140500 --out log.csv --from 10 --to 70
    """
    files = files_of(recording)
    if out is None:
        name = recording.name.removesuffix(SUFFIX)
        out = recording.with_name(f"{name}.csv")
    require_table(out, *files)
    span = Span(_moment("--from", start), _moment("--to", stop))
    if cell_out is not None:
        require_cell(cell_out, *files, out)
    for note in note_texts(damages(recording)):
        click.echo(f"warning: {note}", err=True)
    _emit(out, export(recording, out, span))
    if cell_out is not None:
        write_text(cell_out, str(read_configuration(recording).get("text", "")))
        click.echo(f"{cell_out}: written")


def _moment(option: str, text: str | None) -> float | datetime | None:
    try:
        return None if text is None else moment(text)
    except InputError as error:
        raise InputError(f"{option}: {error}") from None


def _emit(out: Path, exported: Exported) -> None:
    lasted = (exported.last or 0.0) - (exported.first or 0.0)
    states = ", ".join(f"{count} {state}" for state, count in exported.states.items())
    click.echo(f"{out}: {exported.rows} cycles over {lasted:.3f} s ({states})")
    if exported.gaps:
        click.echo(f"warning: {exported.gaps} cycles in between were not recorded", err=True)
    if exported.back is not None:
        click.echo(
            f"warning: {out}: row {exported.back + 2}: the controller's clock goes back; "
            "export each stretch with --from and --to",
            err=True,
        )
