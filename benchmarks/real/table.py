"""Logs and cells as files: read, split, written; nothing of the project's own readers."""

from __future__ import annotations

import csv
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from benchmarks.real import arms

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
MOVING = ("tracking", "torque")
MOST_JUDGED = 400  # poses that judge a fit of a few others
BUILT_IN = {"ur3e": arms.UR3E, "ur10e": arms.UR10E, "ur10": arms.UR10}


@dataclass(frozen=True)
class Table:
    """A log: its header, and its numbers (N, columns); what is no number is nan."""

    names: tuple[str, ...]
    values: Array

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.values)

    def get(self, name: str) -> Array | None:
        """Return a column (N,), or a vector (N, k) of ``name_0..``; None where it is not there."""
        if name in self.names:
            return self.values[:, self.names.index(name)]
        own = [k for k, n in enumerate(self.names) if n.rpartition("_")[0] == name
               and n.rpartition("_")[2].isdigit()]  # fmt: skip
        return self.values[:, own] if own else None

    def joints(self) -> Array:
        """Return the measured joints (N, n), or where there are none the commanded ones."""
        q = self.get("actual_q")
        q = self.get("target_q") if q is None else q
        if q is None:
            raise ValueError("log: found no actual_q and no target_q")
        return q

    @property
    def time(self) -> Array:
        """Return the time of each row; its number where the log has none."""
        time = self.get("timestamp")
        return np.arange(len(self), dtype=float) if time is None else time

    @property
    def moving(self) -> bool:
        """Return whether the rows are a recording, not poses: under a second apart."""
        return bool(np.median(np.diff(self.time)) < 1.0)

    def channels(self) -> tuple[str, ...]:
        """Return the channels that the columns show."""
        has = {n: self.get(n) is not None for n in (
            "measured_position", "ft_raw_wrench", "target_q", "actual_q",
            "actual_current_as_torque")}  # fmt: skip
        out = ["position"] if has["measured_position"] else []
        out += ["wrench"] if has["ft_raw_wrench"] else []
        out += ["tracking"] if has["target_q"] and has["actual_q"] and self.moving else []
        return (*out, "torque") if has["actual_current_as_torque"] and self.moving else tuple(out)

    def rows(self, keep: Mask) -> Table:
        """Return the table with the rows that are kept."""
        return Table(self.names, self.values[keep])

    def replaced(self, name: str, values: Array) -> Table:
        """Return the table with another vector column (N, k)."""
        out = self.values.copy()
        for k in range(values.shape[1]):
            out[:, self.names.index(f"{name}_{k}")] = values[:, k]
        return Table(self.names, out)

    def with_approach(self) -> Table:
        """Return a table of poses with the sign of each joint's last motion beside every row.

        Rows that are left out of a log would take their neighbours' last motions with them.
        """
        if self.moving or self.get("approach_0") is not None:
            return self
        q = self.joints()
        moved = np.sign(np.diff(q, axis=0, prepend=q[:1]))
        session = self.get("session")
        begins = np.zeros(len(q), dtype=bool)
        if session is not None:  # what came before a session is not known
            begins = np.diff(session, prepend=session[0]) != 0
        moved[begins] = 0.0
        for row in range(1, len(q)):
            still = (moved[row] == 0) & ~begins[row]
            moved[row, still] = moved[row - 1, still]
        names = (f"approach_{k}" for k in range(q.shape[1]))
        return Table((*self.names, *names), np.hstack([self.values, moved]))

    def write(self, path: Path) -> None:
        """Write the table as CSV; nan as an empty field."""
        with path.open("w", newline="", encoding="utf-8") as file:
            out = csv.writer(file)
            out.writerow(self.names)
            for row in self.values.tolist():
                out.writerow(["" if x != x else f"{x:.10g}" for x in row])


def read_table(path: Path) -> Table:
    """Return a log."""
    with path.open(encoding="utf-8") as file:
        rows = csv.reader(file)
        names = tuple(next(rows))
        values = [[_number(x) for x in row] for row in rows if row]
    return Table(names, np.array(values))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def read_cell(path: Path) -> dict[str, Any]:
    """Return a cell's document."""
    document: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return document


def links_of(cell: dict[str, Any]) -> tuple[arms.Link, ...] | None:
    """Return the arm's DH rows; None of one that a URDF describes."""
    robot = cell["robot"]
    if "dh" in robot:
        return arms.links_of(robot["dh"])
    return BUILT_IN.get(robot.get("model", ""))


def copy_cell(source: Path, folder: Path) -> Path:
    """Return the cell copied into a folder, with the URDF beside it."""
    for path in source.parent.glob("*.urdf"):
        shutil.copy(path, folder / path.name)
    return Path(shutil.copy(source, folder / "cell.yaml"))


def halves(table: Table, seed: int = 0, poses: int | None = None) -> tuple[Mask, Mask]:
    """Return the rows to fit (four fifths) and to judge: a fifth of a recording, else at random.

    Of a recording it is the last fifth, with ``seed`` 1 the one before, and so on. With ``poses``
    so many poses are fitted, and at most MOST_JUDGED of the others are judged.
    """
    count = len(table)
    judged = np.zeros(count, dtype=bool)
    if poses is not None:
        order = np.random.default_rng(1000 + seed).permutation(count)
        fitted = judged.copy()
        fitted[order[:poses]] = True
        judged[order[poses : poses + MOST_JUDGED]] = True
        return fitted, judged
    if table.moving:
        fifth = 4 - seed % 5
        judged[int(0.2 * fifth * count) : int(0.2 * (fifth + 1) * count)] = True
    else:
        order = np.random.default_rng(seed).permutation(count)
        judged[order[: max(count // 5, 1)]] = True
    return ~judged, judged
