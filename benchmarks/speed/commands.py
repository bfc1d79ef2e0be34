"""What commands cost, as a user has them: CPU time and memory of a whole process.

    python -m benchmarks.speed.commands [--rows 1000000] [--repeats 3] [--only predict]

A simulated UR10e at random poses under three payloads, measured to 30 um, one of 500 an outlier.
Prints the table of docs/performance.md: the least of the repeats' CPU times, the largest memory;
one thread. Beside other work CPU times grow; the ratio to the first row, measured in the same run,
grows less. ``coverage``, which numba imports where it is installed, is hidden: users have none.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

CELL = """robot: {model: ur10e}
tool: {tcp: {xyz: [0, 0, 0.1], rpy: [0, 0, 0]}}
metrology: {registered: false, sigma: 3.0e-5}
"""


PLAIN = "import sys; sys.modules['coverage'] = None; "  # as where only Gapbridge is installed
YARDSTICK = ["-c", f"{PLAIN}import numba"]  # a process that starts with everything of numba
COMMAND = ["-c", f"{PLAIN}from gapbridge.bridge.cli.main import main; main()"]


@dataclass(frozen=True)
class Row:
    """A command and what it may cost."""

    label: str
    arguments: list[str]  # of Python
    seconds: float | None = None  # CPU
    memory: float | None = None  # MB


def cost(arguments: list[str], repeats: int, *, warm: bool = False) -> tuple[float, float]:
    """Return CPU time (s) and memory (MB) of Python; ``warm``: it ran before.

    Raises SystemExit where it fails.
    """
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "GAPBRIDGE_THREADS": "1"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    found = []
    for _ in range(repeats + (not warm)):  # the first compiles what has never been
        process = subprocess.Popen(
            [sys.executable, *arguments], env=environment,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        _, status, used = os.wait4(process.pid, 0)
        if status:
            raise SystemExit(f"python {' '.join(arguments)}: ended with {status}")
        found.append((used.ru_utime + used.ru_stime, used.ru_maxrss / 1024))
    return min(cpu for cpu, _ in found[-repeats:]), max(memory for _, memory in found[-repeats:])


def rows_of(folder: Path, rows: int) -> list[Row]:
    """Return the commands, their files written to ``folder``."""
    cell, fitted = folder / "cell.yaml", folder / "fitted.yaml"
    cell.write_text(CELL, encoding="utf-8")
    # by a process of its own: a command's memory counts from what its parent holds
    writer = [sys.executable, "-m", "benchmarks.speed.command_logs", str(folder), str(rows)]
    subprocess.run(writer, check=True)
    many, tenth, poses, moving = (
        folder / f"{name}.parquet" for name in ("many", "tenth", "poses", "moving")
    )

    def row(label: str, seconds: float, memory: float | None, *arguments: object) -> Row:
        return Row(label, [*COMMAND, *map(str, arguments)], seconds, memory)

    return [
        row(f"`fit`, {rows:,} rows, Parquet", 4, 400, "fit", many, "--cell", cell, "--out", fitted),
        row(f"`predict`, {rows:,} rows, Parquet in and out, with standard deviations", 2, 400,
            "predict", many, "--cell", fitted, "--out", folder / "p.parquet"),
        row(f"`compensate`, {rows // 10:,} rows, Parquet to CSV", 1, None,
            "compensate", tenth, "--cell", fitted, "--out", folder / "c.csv"),
        row("`diagnose`, 70 poses, CSV", 1.5, 200,
            "diagnose", folder / "poses.csv", "--cell", cell),
        row("`diagnose`, 70 poses, Parquet", 1.5, 200, "diagnose", poses, "--cell", cell),
        row(f"`diagnose`, {rows:,} rows of motion at 500 Hz, all rows judged", 15, 500,
            "diagnose", moving, "--cell", cell),
        row("`--help`", 0.1, None, "--help"),
        row("`explain`", 0.1, None, "explain"),
        row("`explain backlash`", 0.1, None, "explain", "backlash"),
        row("`status`", 0.1, None, "status"),
    ]  # fmt: skip


def line(row: Row, cpu: float, memory: float, yardstick: float) -> str:
    """Return one row of the table."""
    goal, met = "-", "-"
    if row.seconds is not None:
        goal = f"{row.seconds:g} s" + ("" if row.memory is None else f", {row.memory:g} MB")
        kept = {"time": cpu <= row.seconds}
        if row.memory is not None:
            kept["memory"] = memory <= row.memory
        held = [name for name, holds in kept.items() if holds]
        met = "yes" if len(held) == len(kept) else f"{held[0]} only" if held else "**no**"
    return f"| {row.label} | {cpu:.2f} | {cpu / yardstick:.1f} | {memory:.0f} | {goal} | {met} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", default="", help="commands whose row has this in it")
    options = parser.parse_args()
    before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="commands-") as name:
        print("| command | CPU, s | times the first row | memory, MB | goal | met |")
        print("| --- | --- | --- | --- | --- | --- |")
        first = Row('`python -c "import numba"`', YARDSTICK)
        yardstick, memory = cost(YARDSTICK, max(options.repeats, 3))
        print(line(first, yardstick, memory, yardstick), flush=True)
        for row in rows_of(Path(name), options.rows):
            if options.only in row.label or "fit" in row.arguments:  # others read what it wrote
                print(line(row, *cost(row.arguments, options.repeats), yardstick), flush=True)
    load = f"load average {before:.1f} before, {os.getloadavg()[0]:.1f} after"
    print(f"{load}, {time.strftime('%Y-%m-%d')}")


if __name__ == "__main__":
    main()
