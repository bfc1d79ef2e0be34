"""The logs that the commands are measured on: ``python -m benchmarks.speed.command_logs``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyarrow
from pyarrow import csv, parquet

from gapbridge.core.arm import builtin_arm
from gapbridge.core.dynamics import predict_torque, with_pieces
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import motion_of

FEW = 1000  # rows up to which a log is written as CSV, too
AXIAL = np.array([8, 9, 10, 20, 25, 30]) * 1e-6  # rad/Nm
RADIAL = np.array([2, 3, 2, 5, 5, 9]) * 1e-6


def write_log(path: Path, rows: int) -> None:
    """Write a log of ``rows`` measured poses."""
    rng = np.random.default_rng(1)
    tool = np.eye(4)
    tool[2, 3] = 0.1
    model = Model(builtin_arm("ur10e"), tool).with_compliance(AXIAL, RADIAL)
    q, mass = rng.uniform(-2, 2, (rows, 6)), rng.choice([0.0, 3.0, 6.0], rows)
    cog = np.tile([0.0, 0.0, 0.1], (rows, 1))
    position = model.predict(q, Loads(mass, cog)).position + rng.normal(0, 3e-5, (rows, 3))
    outlier = rng.random(rows) < 0.002
    position[outlier] += rng.normal(0, 5e-3, (outlier.sum(), 3))
    columns = {f"actual_q_{i}": q[:, i] for i in range(6)} | {"payload": mass}
    columns |= {f"payload_cog_{i}": cog[:, i] for i in range(3)}
    columns |= {f"measured_position_{i}": position[:, i] for i in range(3)}
    parquet.write_table(pyarrow.table(columns), path)
    if rows <= FEW:
        csv.write_csv(pyarrow.table(columns), path.with_suffix(".csv"))


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


def main(folder: Path, rows: int) -> None:
    """Write the logs of ``rows`` poses, a tenth of them and 70, and of ``rows`` rows of motion."""
    for name, count in (("many", rows), ("tenth", rows // 10), ("poses", 70)):
        write_log(folder / f"{name}.parquet", count)
    write_moving_log(folder / "moving.parquet", rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
