"""Run the blind benchmark: ``python -m benchmarks.blind --seeds 20 --workers 2``."""

from __future__ import annotations

import importlib
import shutil
from pathlib import Path

import click
from rich.console import Console
from rich.progress import track

from benchmarks.blind import cases
from benchmarks.blind.draws import POSITION_EFFECTS
from benchmarks.blind.page import write_page
from benchmarks.blind.report import print_report, print_sensitivity
from benchmarks.blind.run import (
    Command,
    Diagnose,
    chosen_kinds,
    fresh_seed,
    has_pinocchio,
    jobs_of,
    run_blind,
    run_sensitivity,
)
from gapbridge.bridge.document.output_file import require_folder, require_writable
from gapbridge.core.errors import InputError

PAGE = "blind.html"


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--seeds", type=click.IntRange(1), default=20, show_default=True,
              help="Cases of each kind.")  # fmt: skip
@click.option("--kinds", "names", default=None, help="Kinds or groups, by commas; see --list.")
@click.option("--quick", is_flag=True, help="Two cases of each kind.")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True,
              help="Processes side by side.")  # fmt: skip
@click.option("--seed", "first", type=click.IntRange(0), default=None,
              help="First seed, to repeat a run.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), default=None,
              help="Folder for blind.html and the diagnoses.")  # fmt: skip
@click.option("--command", default="gapbridge diagnose", show_default=True,
              help="The diagnosis, as a program of its own.")  # fmt: skip
@click.option("--in-process", "inside", default=None,
              help="module:function(log, cell, withhold) -> dict, instead.")  # fmt: skip
@click.option("--sensitivity", "small", is_flag=True,
              help="Also find the smallest effect found in 95 % of cases (slow).")  # fmt: skip
@click.option("--list", "listing", is_flag=True, help="Show the kinds and stop.")
def main(
    seeds: int, names: str | None, quick: bool, workers: int, first: int | None,
    out: Path | None, command: str, inside: str | None, small: bool, listing: bool,
) -> None:  # fmt: skip
    """Draw cases whose effect is withheld, have them diagnosed, and score the answers.

    Example: gapbridge blind --quick --out out/blind
    """
    console = Console(emoji=False)
    if listing:
        for group, own in cases.kinds().items():
            console.print(f"[bold]{group}[/]: {' '.join(own)}")
        return
    how: Diagnose = _function(inside) if inside else _program(command)
    wanted = names.split(",") if names else None
    if out is not None:
        try:
            require_folder(out, "--out")
            require_writable(out / PAGE)
        except InputError as error:
            raise click.UsageError(str(error)) from None
    count = 2 if quick else seeds
    first = fresh_seed() if first is None else first
    console.print(f"first seed {first} (repeat with --seed {first})")
    if not has_pinocchio():
        console.print("the torque channel is left out: its truth needs Pinocchio (the test extra)")
    total = len(jobs_of(chosen_kinds(wanted), count, first))
    try:
        run = run_blind(count, wanted, workers, out, how, first)
        scores = list(track(run, description="blind", total=total, console=console))
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    order = {k: i for i, k in enumerate(chosen_kinds(wanted))}
    scores.sort(key=lambda s: (order.get(s.kind, 0), s.seed))
    print_report(scores, console)
    found = []
    if small:
        effects = [k for k in chosen_kinds(wanted) if k in POSITION_EFFECTS]
        found = run_sensitivity(effects, range(first, first + count), workers, how)
        print_sensitivity(found, console)
    if out is not None:
        page = out / PAGE
        write_page(page, scores, "Gapbridge: the blind benchmark",
                   f"{len(scores)} cases, first seed {first}.", found)  # fmt: skip
        console.print(f"written: {page}")


def _program(line: str) -> Command:
    """Return the program of a command line. Raises click.UsageError if it names none."""
    try:
        command = Command.parse(line)
    except ValueError:
        raise click.UsageError(f"--command: found {line!r}, expected a program") from None
    if shutil.which(command.command[0]) is None:
        raise click.UsageError(f"--command: found no program {command.command[0]!r}, expected one")
    return command


def _function(name: str) -> Diagnose:
    """Return the function ``module:function``. Raises click.UsageError where there is none."""
    module, _, function = name.partition(":")
    try:
        found: Diagnose = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise click.UsageError(
            f"--in-process: found {name!r}, expected module:function ({error})"
        ) from None
    if not callable(found):
        raise click.UsageError(f"--in-process: found {name!r}, expected a function")
    return found


if __name__ == "__main__":
    main()
