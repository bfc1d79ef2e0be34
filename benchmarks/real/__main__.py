"""The diagnosis on real logs beside plain least squares: ``python -m benchmarks.real``."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from benchmarks.real.judging import Outcome, Program, judge_carried, judge_log
from benchmarks.real.sets import CARRIED, SPLIT

SCALE = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "N": (1.0, "N"), "Nm": (1.0, "Nm")}


@click.command()
@click.option("--data", "folders", multiple=True, type=click.Path(path_type=Path),
              required=True,
              help="Folder of logs, one folder each; may be given several times.")  # fmt: skip
@click.option("--only", "names", default=None, help="Logs by name, by commas.")
@click.option("--split", type=click.Choice(["tune", "held back"]), default=None,
              help="Only this half.")  # fmt: skip
@click.option("--carried/--no-carried", default=True, help="Also carry answers to later logs.")
@click.option("--command", default="gapbridge", show_default=True, help="The program to judge.")
@click.option("--draw", type=int, default=0, show_default=True,
              help="Seed of the judged poses; of a recording: its fifth from the end.")  # fmt: skip
@click.option("--poses", type=click.IntRange(5), default=None,
              help="Fit so many random poses, and judge others.")  # fmt: skip
@click.option("--stand-ins", "stand_ins", is_flag=True,
              help="Judge the model with stand-ins, not accusations alone.")  # fmt: skip
@click.option("--json", "file", type=click.Path(path_type=Path), default=None,
              help="Write the outcomes.")  # fmt: skip
def main(folders: tuple[Path, ...], file: Path | None, **values: Any) -> None:
    """Judge the diagnosis on rows that its fit did not see, beside plain least squares.

    Public sets are converted by ``python -m benchmarks.real.convert``.
    """
    console = Console()
    if not console.is_terminal:
        console.width = 190
    outcomes: list[Outcome] = []
    for name, job in _jobs(_logs_in(folders, console), _Options(**values)):
        try:
            for outcome in job:
                console.print(_line(outcome))
                outcomes.append(outcome)
        except (RuntimeError, ValueError) as error:
            console.print(f"{name}: skipped, {error}")
    console.print(_table(outcomes))
    if file is not None:
        document = json.dumps([o.document() for o in outcomes], indent=1)
        file.write_text(document, encoding="utf-8")


@dataclass(frozen=True)
class _Options:
    """Which logs are judged, and how."""

    names: str | None
    split: str | None
    carried: bool
    command: str
    draw: int
    poses: int | None
    stand_ins: bool

    def includes(self, name: str) -> bool:
        own = SPLIT.get(name.rpartition(" > ")[2], "held back")
        named = not self.names or name in self.names.split(",")
        return named and (self.split is None or own == self.split)


def _logs_in(folders: tuple[Path, ...], console: Console) -> dict[str, Path]:
    """Return the folder of each log by its name."""
    found: dict[str, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            console.print(f"{folder}: skipped, there is no such folder")
            continue
        found |= {p.parent.name: p.parent for p in sorted(folder.glob("*/log.csv"))}
    return found


def _jobs(logs: dict[str, Path], options: _Options) -> Iterator[tuple[str, Iterable[Outcome]]]:
    """Yield name and outcomes of each log, then of those whose answers are carried to others."""
    program = Program(options.command, options.stand_ins)
    for name, folder in logs.items():
        if options.includes(name):
            yield name, judge_log(folder, program, options.draw, options.poses)
    if not options.carried or options.poses is not None:
        return
    later_of: dict[str, list[Path]] = {}
    for a, b in CARRIED:
        if {a, b} <= set(logs) and options.includes(f"{a} > {b}"):
            later_of.setdefault(a, []).append(logs[b])
    for first, later in later_of.items():
        yield f"{first} > ", judge_carried(logs[first], later, program)


def _line(o: Outcome) -> str:
    sizes = f"judged {_size(o, o.judged)}, rival {_size(o, o.rival)}"
    return f"{o.log} {o.channel}: {sizes}, {_ratio(o)}"


def _ratio(o: Outcome) -> str:
    """Return the ratio with its standard error: within it of 1 the two are alike."""
    return f"{o.ratio:.3f} ± {o.ratio_error:.3f}"


def _size(o: Outcome, value: float | None) -> str:
    if value is None:
        return "–"
    factor, unit = SCALE.get(o.unit, (1.0, o.unit))
    return f"{factor * value:.4g} {unit}"


def _table(outcomes: list[Outcome]) -> Table:
    table = Table(title="real logs: what is left of rows that the fit did not see")
    for head in ("log", "channel", "half", "rows", "gap", "reported held out", "its new region",
                 "judged", "least squares", "published", "ratio", "verdict", "accused", "absurd",
                 "s"):  # fmt: skip
        table.add_column(head, overflow="fold")
    for o in outcomes:
        theirs = "–"
        if o.published is not None:
            ours, other, what = o.published
            theirs = f"{1e3 * other:.3g} mm ({what}); ours {1e3 * ours:.3g}"
        table.add_row(
            o.log, o.channel, o.split, str(o.rows), _size(o, o.gap), _size(o, o.reported),
            _size(o, o.reported_new_region), _size(o, o.judged), _size(o, o.rival), theirs,
            _ratio(o), o.verdict, " ".join(o.accused) or "–",
            "; ".join(o.absurd) or "–", f"{o.seconds:.1f}",
        )  # fmt: skip
    return table


if __name__ == "__main__":
    main()
