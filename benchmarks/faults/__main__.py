"""``python -m benchmarks.faults``: the matrix of faults and random sequences of them."""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import click

from benchmarks.faults import matrix as matrix_module
from benchmarks.faults import sequences as sequences_module
from benchmarks.faults.links import LINKS
from benchmarks.faults.matrix import read_results, run_matrix
from benchmarks.faults.report import PAGE, counted, fill, fill_matrix
from benchmarks.faults.sequences import Tally, read_tally, run_sequences
from benchmarks.faults.table import ROWS


@click.command()
@click.option("--repeat", default=3, show_default=True, help="How often each fault is made.")
@click.option("--link", "links", multiple=True, type=click.Choice(list(LINKS)), help="Only these.")
@click.option("--row", "keys", multiple=True, type=click.Choice([r.key for r in ROWS]))
@click.option("--rate", type=float, help="Hz, of the UR links; left out: their usual one.")
@click.option("--sequences", default=0, show_default=True, help="Random sequences, over all links.")
@click.option("--seed", default=1, show_default=True, help="Of the random sequences.")
@click.option("--minutes", default=120.0, show_default=True, help="No fault is begun after them.")
@click.option(
    "--page", is_flag=True, help="Write the tables of docs/reliability.md and evidence/faults.md."
)
@click.option(
    "--from", "kept", multiple=True, type=click.Path(exists=True, path_type=Path),
    help="Make nothing: write the tables from the folders (--out) of former runs.",
)  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Folder of cells, logs and results.")
def main(
    repeat: int, links: tuple[str, ...], keys: tuple[str, ...], rate: float | None,
    sequences: int, seed: int, minutes: float, page: bool, kept: tuple[Path, ...],
    out: Path | None,
) -> None:  # fmt: skip
    """Make every fault on every link where it can happen, and see what comes of it."""
    if kept:
        _write_kept(kept)
        return
    folder = out or Path(tempfile.mkdtemp(prefix="faults-"))
    chosen, begun = links or tuple(LINKS), time.monotonic()
    wrong = 0
    if repeat:
        results = run_matrix(chosen, keys, repeat, folder, rate, click.echo, 60.0 * minutes)
        wrong += sum(bool(result.wrong and result.judged) for result in results)
        click.echo(counted(results))
        if page:
            fill_matrix(ROWS, results)
    if sequences:
        left = 60.0 * minutes - (time.monotonic() - begun)
        tally = run_sequences(chosen, sequences, seed, folder, rate, click.echo, left)
        wrong += tally.violated + tally.stuck
        click.echo(tally.message())
        if page:
            fill(PAGE, "sequences", tally.table())
    sys.exit(1 if wrong else 0)


def _write_kept(folders: tuple[Path, ...]) -> None:
    """Write the tables of the page from what runs have kept."""
    results = [r for f in folders if (f / matrix_module.KEPT).exists() for r in read_results(f)]
    if results:
        fill_matrix(ROWS, results)
    tally = Tally()
    for folder in folders:
        if (folder / sequences_module.KEPT).exists():
            tally.add(read_tally(folder))
    if tally.sequences:
        fill(PAGE, "sequences", tally.table())


if __name__ == "__main__":
    main()
