"""Runs the rows of the table, link by link, on one rig a link where that is possible."""

from __future__ import annotations

import json
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from benchmarks.faults.injection import make_fault
from benchmarks.faults.links import LINKS, OFFSET_RATE, Link
from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Result, Row
from benchmarks.faults.table import rows_of

Say = Callable[[str], None]
KEPT = "results.jsonl"


def run_matrix(
    links: Sequence[str], keys: Sequence[str], repeat: int, folder: Path, rate: float | None,
    say: Say, limit: float,
) -> list[Result]:  # fmt: skip
    """Make every fault ``repeat`` times on each of its links; returns what became of each.

    ``keys``: rows, none for all. ``limit``: s, after which no further fault is begun.
    """
    until = time.monotonic() + limit
    found: list[Result] = []
    for name in links:
        link = LINKS[name](rate if name.startswith("ur_") else None)
        rows = [row for row in rows_of(name) if not keys or row.key in keys]
        for result in _on_one_rig(link, rows * repeat, folder / name, until, say):
            found.append(result)
            _keep(folder, result)
        for i, row in enumerate(rows_of(name, shared=False) * repeat):
            if (keys and row.key not in keys) or time.monotonic() > until:
                continue
            result = run_alone(row, link, folder / f"{name}-{i}")
            found.append(result)
            say(line(result))
            _keep(folder, result)
    return found


def run_alone(row: Row, link: Link, folder: Path) -> Result:
    """Make a fault that has a rig, or even a daemon, of its own."""
    try:
        if row.apart is not None:
            return row.apart(row, link, folder)
        assert row.own is not None
        with row.own(link, folder) as rig:
            return _made(rig, row)
    except Exception as error:  # it did not come up
        traceback.print_exc(file=sys.stderr)
        return Result(
            row.key, link.name, link.cycle, None, "not made", 0.0, OFFSET_RATE * link.cycle,
            (f"{type(error).__name__}: {error}",),
        )  # fmt: skip


def _on_one_rig(
    link: Link, rows: Sequence[Row], folder: Path, until: float, say: Say
) -> Iterator[Result]:
    """Make faults one after the other; a rig that is beyond recovery is replaced by a new one."""
    left = list(rows)
    while left and time.monotonic() < until:
        with Rig(link, folder) as rig:
            while left and time.monotonic() < until:
                row = left.pop(0)
                result = _made(rig, row)
                say(line(result))
                yield result
                if rig.run.error is not None or not rig.run.alive:
                    break


def _made(rig: Rig, row: Row) -> Result:
    """Make a fault, once."""
    try:
        return make_fault(rig, row)
    except Exception as error:
        return _failed(rig, row, error)


def _failed(rig: Rig, row: Row, error: Exception) -> Result:
    """Return the result of a fault after which the rig could not go on."""
    traceback.print_exc(file=sys.stderr)
    bounds = rig.checker.bounds
    return Result(
        row.key, rig.link.name, rig.link.cycle, None, rig.run.state.name.lower(),
        rig.checker.found.largest_step, bounds.offset_rate * bounds.cycle,
        (f"{type(error).__name__}: {error}",),
    )  # fmt: skip


def _keep(folder: Path, result: Result) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / KEPT).open("a", encoding="utf-8") as file:
        file.write(json.dumps(asdict(result)) + "\n")


def read_results(folder: Path) -> list[Result]:
    """Return what a run has kept in its folder."""
    lines = (folder / KEPT).read_text(encoding="utf-8").splitlines()
    kept = [json.loads(text) for text in lines]
    return [Result(**{**given, "wrong": tuple(given["wrong"])}) for given in kept]


def line(result: Result) -> str:
    """Return a result in one line."""
    after = "not detected"
    if result.detected is not None:
        after = f"after {result.cycles:.1f} cycles ({1e3 * result.detected:.0f} ms)"
    step = f"largest step {1e6 * result.largest_step:.0f} um"
    message = f"{result.link:15} {result.row:24} {after:34} {step:24} end {result.end}"
    verdict = "NOT AS EXPECTED"
    if not result.judged:
        verdict = f"MACHINE LATE BY {1e3 * result.late:.0f} MS, NOT JUDGED"
    return message + "".join(f"\n    {verdict}: {wrong}" for wrong in result.wrong)
