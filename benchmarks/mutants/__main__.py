"""``python -m benchmarks.mutants``: how many of the listed mistakes the tests notice, by folder."""

from __future__ import annotations

import json
import re
import tempfile
import time
from collections import defaultdict
from dataclasses import asdict
from pathlib import Path

import click

from benchmarks.mutants.mutant import Mutant, read_mutants
from benchmarks.mutants.trial import Trial, Verdict
from gapbridge.core.errors import InputError


@click.command()
@click.option("--only", default="", help="Those whose file, text or list has this in it.")
@click.option("--part", default="1/1", help="K/N: every N-th from the K-th, for N runs beside.")
@click.option("--out", type=click.Path(path_type=Path), help="JSON lines, one a mutant.")
@click.option("--resume", is_flag=True, help="Skip what OUT says was noticed.")
def main(only: str, part: str, out: Path | None, resume: bool) -> None:
    """Make each listed mistake in a copy of the checkout and run the tests that must notice it.

    A test counts only where it passes without the mistake. Exit 1 where one goes unnoticed.
    """
    if resume and out is None:
        raise InputError("--resume: expected --out, the file to go on with")
    mutants = [m for m in read_mutants() if only in m.file or only in m.what]
    mutants = mutants[_part(part)]
    if not mutants:
        raise InputError(f"--only, --part: found no mutant with {only!r} in part {part}")
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    verdicts = noticed_in(out, mutants) if resume and out is not None else []
    done = {verdict.mutant for verdict in verdicts}
    mutants = [mutant for mutant in mutants if mutant not in done]
    with tempfile.TemporaryDirectory() as folder:
        trial = Trial(Path(folder))
        for number, mutant in enumerate(mutants, 1):
            verdict = trial.judge(mutant)
            verdicts.append(verdict)
            word = "noticed" if verdict.killed else "UNNOTICED"
            click.echo(f"{number:3}/{len(mutants)} {word:9} {mutant.file}: {mutant.what}")
            click.echo(f"        {verdict.detail}", err=verdict.killed)
            if out is not None:
                with out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(asdict(verdict)) + "\n")
    click.echo("\n".join(["", *table(verdicts), f"{time.monotonic() - begun:.0f} s"]))
    if not all(v.killed for v in verdicts):
        raise SystemExit(1)


def noticed_in(out: Path, mutants: list[Mutant]) -> list[Verdict]:
    """Return what a file of an earlier run says of these mutants, as far as each was noticed."""
    if not out.exists():
        return []
    found = {}
    for line in out.read_text(encoding="utf-8").splitlines():
        record = json.loads(line)
        mutant = Mutant(**{**record["mutant"], "tests": tuple(record["mutant"]["tests"])})
        if record["killed"] and mutant in mutants:
            found[mutant] = Verdict(mutant, True, record["detail"])
    return list(found.values())


def _part(given: str) -> slice:
    """Return which of a list belong to part "K/N"."""
    match = re.fullmatch(r"(\d+)/(\d+)", given)
    if match is None or not 1 <= (first := int(match[1])) <= (every := int(match[2])):
        raise InputError(f"--part: found {given!r}, expected K/N with K from 1 to N")
    return slice(first - 1, None, every)


def table(verdicts: list[Verdict]) -> list[str]:
    """Return the shares by folder, as the lines of a Markdown table."""
    by_folder: dict[str, list[bool]] = defaultdict(list)
    for verdict in verdicts:
        by_folder[verdict.mutant.folder].append(verdict.killed)
    by_folder["all"] = [verdict.killed for verdict in verdicts]
    rows = ["| folder | mutants | noticed |", "| --- | --- | --- |"]
    for folder, killed in sorted(by_folder.items(), key=lambda item: (item[0] == "all", item[0])):
        share = f"{sum(killed)} ({100 * sum(killed) / len(killed):.0f} %)"
        rows.append(f"| {folder} | {len(killed)} | {share} |")
    return rows


if __name__ == "__main__":
    try:
        main()
    except InputError as problem:
        raise SystemExit(f"error: {problem}") from None
