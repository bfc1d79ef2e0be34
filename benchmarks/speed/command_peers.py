"""Whole commands beside other libraries on the same log: CPU time and memory of whole processes.

    python -m benchmarks.speed.command_peers [--rows 100000] [--repeats 3] [--figaroh PYTHON]

Prints the second table of docs/performance.md. The others' scripts are peers/whole_jobs.py, imports
and reading included on both sides, one thread; sides take turns, the least of the repeats counts.
FIGAROH (a Python of its own that has it) fits 200 rows under no load, the only ones that it can.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from pyarrow import parquet

from benchmarks.calibration.peers import DataSet, by_figaroh
from benchmarks.speed.command_logs import AXIAL, RADIAL, write_log
from benchmarks.speed.commands import CELL
from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.loads import Loads

PEERS = {"pinocchio": "Pinocchio + scipy", "mujoco": "MuJoCo, its sysid"}
JOBS = ("fit", "predict", "compensate")
CHAIN = ("rotation", "position", "mass", "cog", "gravity", "tool_rotation", "tool_position")
UNLOADED, JUDGED = 200, 60  # rows for FIGAROH to fit, and to judge by
PATIENCE = 600.0  # s
TRUTH = np.concatenate([AXIAL, RADIAL])


def files_for(folder: Path, rows: int) -> None:
    """Write the log, the cell, and the arm as the others read it."""
    (folder / "cell.yaml").write_text(CELL, encoding="utf-8")
    write_log(folder / "log.parquet", rows)
    chain = load_cell(folder / "cell.yaml").model.chain()
    np.savez(folder / "arm.npz", **{name: getattr(chain, name) for name in CHAIN})
    np.save(folder / "flexibilities.npy", TRUTH)
    real = CELL + f"compliance: {{axial: {AXIAL.tolist()}, radial: {RADIAL.tolist()}}}\n"
    (folder / "real.yaml").write_text(real, encoding="utf-8")


def cost(arguments: list[str], repeats: int, *, warm: bool = False) -> tuple[float, float]:
    """Return what ``commands.cost`` does, begun by a small process.

    A process's memory counts from what the one that begins it holds.
    """
    small = "import json, sys; from benchmarks.speed.commands import cost; "
    small += "print(json.dumps(cost(*json.loads(sys.argv[1]), warm=sys.argv[2] == 'True')))"
    call = [sys.executable, "-c", small, json.dumps([arguments, repeats]), str(warm)]
    done = subprocess.run(call, check=True, capture_output=True, text=True)
    cpu, memory = json.loads(done.stdout)
    return cpu, memory


def ours(folder: Path, job: str, suffix: str) -> list[str]:
    """Return the arguments of Python for our command."""
    cell = folder / ("cell.yaml" if job == "fit" else "real.yaml")
    log, out = folder / "log.parquet", folder / f"ours-{job}{suffix}"
    return ["-m", "gapbridge", job, str(log), "--cell", str(cell), "--out", str(out)]


def theirs(folder: Path, library: str, job: str, suffix: str) -> list[str]:
    """Return the arguments of Python for another library's script."""
    names = ("log.parquet", "arm.npz", "flexibilities.npy", f"{library}-{job}{suffix}")
    files = [str(folder / name) for name in names]
    return ["-m", "benchmarks.speed.peers.whole_jobs", library, job, *files]


def tables_apart(one: Path, other: Path) -> float:
    """Return the 99th percentile of how far two tables lie apart, in any row and common column."""
    a, b = parquet.read_table(one), parquet.read_table(other)
    columns = [a[name].to_numpy() - b[name].to_numpy() for name in b.column_names]
    return float(np.quantile(np.abs(columns).max(axis=0), 0.99))


def remark(folder: Path, library: str, job: str) -> str:
    """Return what the others' result is worth beside ours."""
    if job == "fit":
        known = np.array([1, 2, 3, 4, 6, 7, 8, 9, 10, 11])  # gravity bends these about their axes
        cell = load_cell(folder / "ours-fit.yaml")
        found = np.concatenate(cell.model.compliance()), np.load(folder / f"{library}-fit.npy")
        off = [np.abs(c[known] / TRUTH[known] - 1).max() for c in found]
        return f"flexibilities off by at most {off[0]:.1%} (ours), {off[1]:.1%}"
    apart = tables_apart(folder / f"ours-{job}.parquet", folder / f"{library}-{job}.parquet")
    what = "poses, m and rad," if job == "predict" else "setpoints, rad,"
    return f"first order: {what} off ours by up to {apart:.1e} (99 % of rows)"


def line(job: str, figures: dict[str, tuple[float, float]], remarks: dict[str, str]) -> list[str]:
    """Return the rows of one job."""
    own = figures["ours"]
    rows = [f"| `{job}` | ours | {own[0]:.2f} | {own[1]:.0f} | 1 | - |"]
    for library, (cpu, memory) in figures.items():
        if library != "ours":
            shown = (PEERS[library], cpu, memory, cpu / own[0], remarks[library])
            rows.append("| `{}` | {} | {:.2f} | {:.0f} | **{:.1f}** | {} |".format(job, *shown))
    return rows


def least(known: tuple[float, float] | None, new: tuple[float, float]) -> tuple[float, float]:
    """Return the least CPU time and the largest memory of two."""
    return new if known is None else (min(known[0], new[0]), max(known[1], new[1]))


def compared(folder: Path, job: str, repeats: int) -> list[str]:
    """Return the rows of one job, sides in turn."""
    figures: dict[str, tuple[float, float]] = {}
    for turn in range(repeats):
        sides = ["ours", *PEERS]
        for side in sides if turn % 2 == 0 else sides[::-1]:
            suffix = ".parquet" if job != "fit" else ".yaml" if side == "ours" else ".npy"
            call = (
                ours(folder, job, suffix) if side == "ours" else theirs(folder, side, job, suffix)
            )
            figures[side] = least(figures.get(side), cost(call, 1, warm=turn > 0))
    ordered = {side: figures[side] for side in ("ours", *PEERS)}
    return line(job, ordered, {side: remark(folder, side, job) for side in PEERS})


def unloaded(folder: Path, cell: Cell) -> DataSet:
    """Return the log's first rows without payload, as FIGAROH is given them."""
    log = parquet.read_table(folder / "log.parquet")
    position = np.column_stack([log[f"measured_position_{k}"].to_numpy() for k in range(3)])
    kept = np.flatnonzero(log["payload"].to_numpy() == 0)
    kept = kept[np.linalg.norm(position[kept], axis=1) > 0][: UNLOADED + JUDGED]
    few = log.take(kept[:UNLOADED])
    parquet.write_table(few, folder / "unloaded.parquet")
    q = np.column_stack([log[f"actual_q_{i}"].to_numpy() for i in range(cell.arm.n)])[kept]
    count, zeros = len(kept), np.zeros(len(kept), dtype=np.int64)
    readings = Readings(
        "position", q, position[kept], np.full(count, np.nan), Loads(), zeros, zeros, zeros,
        np.arange(count) >= UNLOADED, np.arange(count),
    )  # fmt: skip
    return DataSet("unloaded", cell.model, readings, float("nan"))


def beside_figaroh(folder: Path, python: str, repeats: int) -> list[str]:
    """Return the rows of the fit that FIGAROH can do."""
    data = unloaded(folder, load_cell(folder / "cell.yaml"))
    call = ["-m", "gapbridge", "fit", str(folder / "unloaded.parquet"), "--cell",
            str(folder / "cell.yaml"), "--out", str(folder / "unloaded.yaml")]  # fmt: skip
    cpu, memory = cost(call, repeats)
    held, seconds, parameters, note = by_figaroh(data, python, PATIENCE)
    said = note or f"{parameters} parameters, held-out rms {1e3 * held:.3f} mm; without its imports"
    ratio = "-" if note else f"**{seconds / cpu:.1f}**"
    return [
        f"| `fit`, {UNLOADED} rows | ours | {cpu:.2f} | {memory:.0f} | 1 | - |",
        f"| `fit`, {UNLOADED} rows | FIGAROH | {seconds:.2f} | - | {ratio} | {said} |",
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--figaroh", help="Python that has FIGAROH; left out: not compared")
    options = parser.parse_args()
    before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="command-peers-") as name:
        folder = Path(name)
        files_for(folder, options.rows)
        print(f"| job, {options.rows:,} rows | by | CPU, s | memory, MB | times ours | result |")
        print("| --- | --- | --- | --- | --- | --- |")
        for job in JOBS:
            print("\n".join(compared(folder, job, options.repeats)), flush=True)
        if options.figaroh:
            print("\n".join(beside_figaroh(folder, options.figaroh, options.repeats)))
    load = f"load average {before:.1f} before, {os.getloadavg()[0]:.1f} after"
    print(f"{load}, {time.strftime('%Y-%m-%d')}")


if __name__ == "__main__":
    main()
