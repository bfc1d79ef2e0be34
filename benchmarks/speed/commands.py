"""What commands cost, as a user has them: CPU time and memory of a whole process.

    python -m benchmarks.speed.commands [--rows 1000000] [--repeats 3] [--only predict]

A simulated UR10e at random poses under three payloads, measured to 30 um, one of 500 an outlier.
Prints a table: the least of the repeats' CPU times, the largest memory. One thread.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pyarrow
from pyarrow import parquet

from gapbridge.core.arm import builtin_arm
from gapbridge.core.dynamics import predict_torque, with_pieces
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import motion_of

CELL = """robot: {model: ur10e}
tool: {tcp: {xyz: [0, 0, 0.1], rpy: [0, 0, 0]}}
metrology: {registered: false, sigma: 3.0e-5}
"""


def write_log(path: Path, rows: int) -> None:
    """Write a log of ``rows`` measured poses."""
    rng = np.random.default_rng(1)
    tool = np.eye(4)
    tool[2, 3] = 0.1
    model = Model(builtin_arm("ur10e"), tool).with_compliance(
        np.array([8, 9, 10, 20, 25, 30]) * 1e-6, np.array([2, 3, 2, 5, 5, 9]) * 1e-6
    )
    q, mass = rng.uniform(-2, 2, (rows, 6)), rng.choice([0.0, 3.0, 6.0], rows)
    cog = np.tile([0.0, 0.0, 0.1], (rows, 1))
    position = model.predict(q, Loads(mass, cog)).position + rng.normal(0, 3e-5, (rows, 3))
    outlier = rng.random(rows) < 0.002
    position[outlier] += rng.normal(0, 5e-3, (outlier.sum(), 3))
    columns = {f"actual_q_{i}": q[:, i] for i in range(6)} | {"payload": mass}
    columns |= {f"payload_cog_{i}": cog[:, i] for i in range(3)}
    columns |= {f"measured_position_{i}": position[:, i] for i in range(3)}
    parquet.write_table(pyarrow.table(columns), path)


def write_moving_log(path: Path, rows: int) -> None:
    """Write a log of motion at 500 Hz: joint 2 comes 8 ms late, joint 1 rubs with 4 Nm."""
    rng = np.random.default_rng(2)
    t, delay = np.arange(rows) / 500.0, np.array([0.0, 8e-3, 0.0, 0.0, 0.0, 0.0])
    frequency, phase = rng.uniform(0.05, 0.4, (4, 6)), rng.uniform(0, 6, (4, 6))
    middle = np.array([0.0, -1.5, 1.5, -1.8, -1.5, 0.0])

    def path_at(time: np.ndarray) -> np.ndarray:
        """Return joint angles (N, 6) at times (N, 6)."""
        angle = 2 * np.pi * frequency * time[:, None] + phase
        return middle + np.sum(0.2 * np.sin(angle), axis=1)

    whole = np.tile(t[:, None], (1, 6))
    target, late = path_at(whole), path_at(whole - delay)
    q = late + rng.normal(0, 1e-5, late.shape)
    model = Model(builtin_arm("ur10e"))
    columns = {"timestamp": t, "target_q": target, "actual_q": q}
    found, torque = motion_of(Log(str(path), columns, 6)), np.full(q.shape, np.nan)
    torque[found.rows] = predict_torque(model, with_pieces(model, found))
    torque[:, 0] += 4.0 * np.sign(np.gradient(late[:, 0]))
    columns["actual_current_as_torque"] = torque + rng.normal(0, 0.3, torque.shape)
    names = {f"{name}_{i}": v[:, i] for name, v in columns.items() if v.ndim > 1 for i in range(6)}
    parquet.write_table(pyarrow.table({"timestamp": t} | names), path)


def cost(arguments: list[str], repeats: int) -> tuple[float, float]:
    """Return CPU time (s) and memory (MB) of a command. Raises SystemExit where it fails."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "GAPBRIDGE_THREADS": "1"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    found = []
    for _ in range(repeats + 1):  # the first compiles what has never been
        process = subprocess.Popen(
            [sys.executable, "-m", "gapbridge", *arguments], env=environment,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        _, status, used = os.wait4(process.pid, 0)
        if status:
            raise SystemExit(f"gapbridge {' '.join(arguments)}: ended with {status}")
        found.append((used.ru_utime + used.ru_stime, used.ru_maxrss / 1024))
    return min(cpu for cpu, _ in found[1:]), max(memory for _, memory in found)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", default="", help="commands whose row has this in it")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="commands-") as name:
        folder = Path(name)
        cell, fitted = folder / "cell.yaml", folder / "fitted.yaml"
        cell.write_text(CELL, encoding="utf-8")
        sizes = (options.rows, options.rows // 10, 70)
        many, tenth, poses = (folder / f"{rows}.parquet" for rows in sizes)
        moving = folder / "moving.parquet"
        written = [
            *(
                (write_log, path, rows)
                for path, rows in zip((many, tenth, poses), sizes, strict=True)
            ),
            (write_moving_log, moving, options.rows),
        ]
        for write, path, rows in written:
            # in a process of its own: a command's memory counts from what its parent held
            writer = get_context("spawn").Process(target=write, args=(path, rows))
            writer.start()
            writer.join()
        commands: dict[str, list[object]] = {
            f"`fit`, {options.rows:,} rows, Parquet":
                ["fit", many, "--cell", cell, "--out", fitted],
            f"`predict`, {options.rows:,} rows, Parquet in and out":
                ["predict", many, "--cell", fitted, "--out", folder / "p.parquet"],
            f"`compensate`, {options.rows // 10:,} rows, Parquet to CSV":
                ["compensate", tenth, "--cell", fitted, "--out", folder / "c.csv"],
            "`diagnose`, 70 poses": ["diagnose", poses, "--cell", cell],
            f"`diagnose`, {options.rows:,} rows of motion at 500 Hz":
                ["diagnose", moving, "--cell", cell],
            "`--help`": ["--help"],
            "`explain`": ["explain"],
            "`status`": ["status"],
        }  # fmt: skip
        print("| command | CPU, s | memory, MB |\n| --- | --- | --- |")
        for label, arguments in commands.items():
            if options.only not in label and arguments[0] != "fit":  # others read what it wrote
                continue
            cpu, memory = cost([str(a) for a in arguments], options.repeats)
            print(f"| {label} | {cpu:.2f} | {memory:.0f} |", flush=True)
    load = os.getloadavg()[0]
    print(f"load average {load:.1f}, {time.strftime('%Y-%m-%d')}")


if __name__ == "__main__":
    main()
