"""Logs: what was measured, in RTDE's column names.

Reading checks shape and numbers and names row and column of what is wrong; what a channel needs is
asked for when it is used. CSV goes through numpy, Parquet through pyarrow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.errors import LogError
from core.files import is_file, is_given, read_bytes, read_text
from core.loads import Loads
from core.log.columns import COLUMNS, INDEXED, is_known, misspelt, nearest, written

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Log:
    """One log: ``columns`` holds (N,) or (N, k) arrays by column name; NaN: an empty cell."""

    path: str
    columns: Mapping[str, Array]
    n: int  # joints
    first_row: int = 2  # line of the first data row in the file, for messages
    lines: NDArray[np.int64] | None = None  # (N,) line of each row; None: one after the other
    unknown: tuple[str, ...] = ()  # names of the file's columns that no channel reads
    session_names: tuple[str, ...] = ()  # of several sessions; column session holds their index
    numbers: NDArray[np.int64] | None = None  # (N,) of the rows of several sessions, from 1
    one_clock: bool = True  # False: timestamps of later sessions were shifted behind the first's

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def line(self, row: int | np.integer[Any]) -> int:
        """Return the line of the file that row ``row`` (from 0) stood in, for messages."""
        return int(row) + self.first_row if self.lines is None else int(self.lines[row])

    def has(self, name: str) -> bool:
        """Return whether the log carries the column (group)."""
        return name in self.columns

    def get(self, name: str) -> Array | None:
        """Return a column (group), or None where the log lacks it."""
        return self.columns.get(name)

    def require(self, *names: str) -> Array:
        """Return the first of these columns that the log has, all of its cells finite.

        Raises LogError naming what is missing, and the misspelt column that may be meant, or row
        and column of the first cell that is not a finite number.
        """
        for name in names:
            if name in self.columns:
                self._check_finite(name)
                return self.columns[name]
        wanted = " or ".join(written(name, self.n) for name in names)
        hint = misspelt(self.unknown, names, self.n)
        raise LogError(
            f"{self.path}: columns: found no {wanted}, expected it for this command{hint}"
        )

    def _check_finite(self, name: str) -> None:
        values = self.columns[name]
        flat = values.reshape(len(values), -1)
        bad = np.argwhere(~np.isfinite(flat))
        if len(bad):
            row, column = (int(v) for v in bad[0])
            label = name if values.ndim == 1 else f"{name}_{column}"
            raise LogError(
                f"{self.path}: row {self.line(row)}, column {label}: found "
                f"{flat[row, column]}, expected a finite number"
            )

    def loads(self) -> Loads:
        """Return what acts on the arm, row by row."""
        given = {
            "payload_mass": "payload",
            "payload_cog": "payload_cog",
            "wrench": "actual_TCP_force",
            "temperature": "joint_temperatures",
        }
        found = {key: self.require(name) for key, name in given.items() if self.has(name)}
        mass = found.get("payload_mass")
        if mass is not None and (mass < 0).any():
            row = int(np.argmax(mass < 0))
            raise LogError(
                f"{self.path}: row {self.line(row)}, column payload: found {mass[row]:g}, "
                "expected 0 or more kg"
            )
        return Loads(**found, approach=self.approach(), time=self.times())

    def times(self) -> Array:
        """Return when each row was taken (N,): s of ``timestamp``, else the row's number from 1."""
        if self.has("timestamp"):
            return self.require("timestamp")
        if self.numbers is not None:
            return np.asarray(self.numbers, dtype=float)
        lines = np.arange(len(self)) + self.first_row if self.lines is None else self.lines
        return np.asarray(lines - self.first_row + 1, dtype=float)

    def approach(self) -> Array | None:
        """Return the sign (N, n) of each joint's last motion before the pose, 0 where unknown.

        Where the log does not say, it is the sign of the change from the row before, carried on
        where a joint did not move.
        """
        if self.has("approach"):
            return np.sign(self.require("approach"))
        q = self.columns.get("actual_q", self.columns.get("target_q"))
        if q is None:
            return None
        return last_motion(q)

    def select(self, rows: NDArray[Any] | slice) -> Log:
        """Return the log of some of the rows; each keeps the line that it had in the file."""
        lines = np.arange(len(self)) + self.first_row if self.lines is None else self.lines
        columns = {name: values[rows] for name, values in self.columns.items()}
        numbers = None if self.numbers is None else self.numbers[rows]
        return replace(self, columns=columns, lines=lines[rows], numbers=numbers)


def last_motion(q: Array, dead_band: float = 1e-6) -> Array:
    """Return the sign (N, n) of the last change of each joint (rad) before each row."""
    sign = np.zeros(q.shape)
    change = np.diff(q, axis=0)
    sign[1:] = np.where(np.abs(change) > dead_band, np.sign(change), 0)
    where = np.where(sign != 0, np.arange(len(q))[:, None], 0)
    last = np.maximum.accumulate(where, axis=0)
    return np.take_along_axis(sign, last, axis=0)


def read_log(path: Path | str, n: int) -> Log:
    """Return the log of a CSV or Parquet file for an arm of n joints.

    Raises LogError, naming file, row and column, where the file is missing or empty, rows are
    ragged, a cell is no number, a vector has a gap in its indices or is not of its length.
    """
    path = Path(path)
    if not is_file(path):
        raise LogError(f"{path}: file not found, expected a CSV or Parquet log")
    if path.suffix.lower() in (".parquet", ".pq"):
        names, table = _read_parquet(path)
    else:
        names, table = _read_csv(path)
    if not len(table):
        raise LogError(f"{path}: found no data rows, expected at least one")
    columns = table_columns(path, [name for name in names if is_known(name)], table, n)
    if not columns:
        raise LogError(f"{path}: columns: found none that a log may hold{nearest(names)}")
    unknown = tuple(name for name in names if not is_known(name))
    return Log(str(path), columns, n, unknown=unknown)


def _wanted(names: Sequence[str]) -> list[int]:
    return [i for i, name in enumerate(names) if is_known(name)]


def _read_csv(path: Path) -> tuple[list[str], Array]:
    """Return the names of all columns, and those that are known (rows, known columns)."""
    try:
        text = read_text(path, "utf-8-sig")
    except UnicodeDecodeError:
        raise LogError(f"{path}: found bytes that are no text, expected CSV (UTF-8)") from None
    lines = text.splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise LogError(f"{path}: found an empty file, expected a CSV header")
    delimiter = ";" if lines[0].count(";") > lines[0].count(",") else ","
    names = [name.strip().strip('"') for name in lines[0].split(delimiter)]
    if len(lines) == 1:
        return names, np.empty((0, len(names)))
    width = lines[0].count(delimiter)
    for number, line in enumerate(lines[1:], start=2):
        if line.count(delimiter) != width:
            raise LogError(
                f"{path}: row {number}: found {line.count(delimiter) + 1} cells, "
                f"expected {width + 1} as in the header"
            )
    wanted = _wanted(names)
    if not wanted:
        return names, np.empty((len(lines) - 1, 0))
    try:
        table = np.loadtxt(lines[1:], delimiter=delimiter, usecols=wanted, ndmin=2, comments=None)
    except ValueError:
        table = _read_cells(path, lines, delimiter, names, wanted)
    return names, table


def _read_cells(
    path: Path, lines: list[str], delimiter: str, names: list[str], wanted: list[int]
) -> Array:
    """Read cell by cell: empty cells become NaN, others that are no number are named."""
    table = np.full((len(lines) - 1, len(wanted)), np.nan)
    for number, line in enumerate(lines[1:]):
        cells = line.split(delimiter)
        for column, i in enumerate(wanted):
            cell = cells[i].strip().strip('"')
            if not cell:
                continue
            try:
                table[number, column] = float(cell)
            except ValueError:
                raise LogError(
                    f"{path}: row {number + 2}, column {names[i]}: found {cell!r}, "
                    "expected a number"
                ) from None
    return table


def _read_parquet(path: Path) -> tuple[list[str], Array]:
    """Return the names of all columns, and those that are known (rows, known columns)."""
    import pyarrow
    from pyarrow import parquet

    try:
        data = pyarrow.BufferReader(read_bytes(path)) if is_given() else path
        names = list(parquet.read_schema(data).names)
        wanted = [names[i] for i in _wanted(names)]
        frame = parquet.read_table(data, columns=wanted)
        for name in wanted:
            kind = frame.schema.field(name).type
            types = pyarrow.types
            if not (types.is_floating(kind) or types.is_integer(kind) or types.is_decimal(kind)):
                what = "text" if pyarrow.types.is_string(kind) else str(kind)
                raise LogError(f"{path}: column {name}: found {what}, expected numbers")
        table = [
            frame[name].cast(pyarrow.float64()).to_numpy(zero_copy_only=False) for name in wanted
        ]
    except (pyarrow.ArrowException, OSError) as error:
        raise LogError(f"{path}: found no readable Parquet file ({error})") from None
    rows = frame.num_rows
    return names, np.column_stack(table) if wanted else np.empty((rows, 0))


def table_columns(path: Path, names: Sequence[str], table: Array, n: int) -> dict[str, Array]:
    """Return columns (N,) or (N, k) of a table (N, names), grouped by name.

    Raises LogError where a vector has a gap in its indices, or not its length.
    """
    found: dict[str, dict[int, int]] = {}
    columns: dict[str, Array] = {}
    for position, name in enumerate(names):
        if COLUMNS.get(name) == 0:
            if name in columns:
                raise LogError(f"{path}: column {name}: found twice, expected once")
            columns[name] = np.ascontiguousarray(table[:, position])
            continue
        match = INDEXED.match(name)
        if match and COLUMNS.get(match[1], 0) != 0:
            indices = found.setdefault(match[1], {})
            if int(match[2]) in indices:
                raise LogError(f"{path}: column {name}: found twice, expected once")
            indices[int(match[2])] = position
    for name, indices in found.items():
        expected = COLUMNS[name] or n
        what = f"{expected} columns {name}_0..{expected - 1}"
        for index in range(max(max(indices) + 1, expected)):
            if index >= expected:
                per = f" of a {n}-joint arm" if COLUMNS[name] is None else ""
                raise LogError(
                    f"{path}: column {name}_{index}: found one too many, expected {what}{per}"
                )
            if index not in indices:
                raise LogError(f"{path}: column {name}_{index}: not found, expected {what}")
        columns[name] = np.ascontiguousarray(table[:, [indices[k] for k in range(expected)]])
    return columns
