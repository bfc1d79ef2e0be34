"""Logs of measured data, with RTDE's column names.

Reading checks shape and numbers; errors name row and column. The columns that a channel needs are
checked when it is used. CSV is read by numpy, Parquet by pyarrow.
"""

from __future__ import annotations

import contextlib
import gzip
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import dropwhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Index, Mask
from gapbridge.core.errors import LogError
from gapbridge.core.files import is_file, read_bytes
from gapbridge.core.loads import Loads
from gapbridge.core.log.columns import (
    COLUMNS,
    INDEXED,
    PARQUET,
    did_you_mean,
    is_known,
    nearest,
    wanted_of,
    written,
)
from gapbridge.core.log.parquet_tables import ParquetColumns

GZIP = b"\x1f\x8b"
INSIDE = "\x1f"  # in place of a separator inside quotes, while a line is split
PACKED: dict[bytes, str] = {  # first bytes -> what it is, and what to do
    b"\x28\xb5\x2f\xfd": "a file packed by Zstandard: unpack it (zstd -d)",
    b"\xfd7zXZ\x00": "a file packed by xz: unpack it (unxz)",
    b"BZh": "a file packed by bzip2: unpack it (bunzip2)",
    b"7z\xbc\xaf\x27\x1c": "a 7-Zip archive: unpack it",
    b"PK\x03\x04": "an Excel workbook or a zip archive: save the sheet as CSV, or unpack it",
    b"PAR1": "a Parquet file: give it a name that ends in .parquet",
    b"\xd0\xcf\x11\xe0": "an Excel workbook: save the sheet as CSV",
}
UTF_16 = (b"\xff\xfe", b"\xfe\xff")
LARGEST = 1e20  # of a number in a log: more than any clock's, and its square is finite
STILL = 1e-6  # rad: a smaller change between rows is no motion


@dataclass(frozen=True)
class Log:
    """One log: ``columns`` holds (N,) or (N, k) arrays by column name; NaN: an empty cell."""

    path: str
    columns: Mapping[str, Array]
    n: int  # joints
    first_row: int = 2  # line of the first data row in the file, for messages
    lines: Index | None = None  # (N,) line of each row; None: one after the other
    unknown: tuple[str, ...] = ()  # names of the file's columns that no channel reads
    session_names: tuple[str, ...] = ()  # of several sessions; column session holds their index
    files: tuple[str, ...] = ()  # that several sessions came from; none: ``path`` alone
    numbers: Index | None = None  # (N,) of the rows of several sessions, from 1
    turned: tuple[int, ...] = ()  # joints (from 1) whose angles were moved by whole turns
    # joints (from 1) whose ``actual_qd`` was left out, and how many times the true speeds it was
    wrong_speeds: tuple[tuple[int, ...], float] = ((), 1.0)
    one_clock: bool = True  # False: timestamps of later sessions were shifted behind the first's
    # cache of data derived from these rows (``motion_of``); empty for a selection of rows
    derived: dict[str, Any] = field(init=False, repr=False, compare=False, default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def line(self, row: int | np.integer[Any]) -> int:
        """Return the line of row ``row`` (from 0) in the file, for messages."""
        return int(row) + self.first_row if self.lines is None else int(self.lines[row])

    def has(self, name: str) -> bool:
        """Return whether the log carries the column (group)."""
        return name in self.columns

    def get(self, *names: str) -> Array | None:
        """Return the first of these columns (groups) that the log has, or None."""
        return next((self.columns[name] for name in names if name in self.columns), None)

    def require(self, *names: str) -> Array:
        """Return the first of these columns that the log has, all of its cells finite.

        Raises LogError naming what is missing, and the misspelt column that may be meant, or row
        and column of the first cell that is not a finite number.
        """
        for name in names:
            if name in self.columns:
                self._refuse(name, ~np.isfinite(self.columns[name]), "a finite number")
                return self.columns[name]
        wanted = " or ".join(written(name, self.n) for name in names)
        hint = did_you_mean(self.unknown, names, self.n)
        raise LogError(
            f"{self.path}: columns: found no {wanted}, expected them for this command{hint}"
        )

    def check_size(self) -> None:
        """Raise LogError, naming row and column, for a number too large to calculate with."""
        for name, values in self.columns.items():
            wrong = (np.abs(values) > LARGEST) & np.isfinite(values)
            self._refuse(name, wrong, f"at most {LARGEST:g}")

    def check_within(self, name: str, most: Array, unit: str) -> None:
        """Raise LogError, naming row and column, for a finite number beyond ``most`` (k,).

        A log without the column (group) ``name`` passes.
        """
        values = self.columns.get(name)
        if values is not None:
            wrong = (np.abs(values) > most) & np.isfinite(values)
            self._refuse(name, wrong, f"at most {np.max(most):g} {unit}")

    def _refuse(self, name: str, wrong: Mask, expected: str) -> None:
        """Raise LogError for the first cell of a column (group) that is ``wrong``."""
        if not wrong.any():
            return
        flat = self.columns[name].reshape(len(self), -1)
        row, column = (int(v) for v in np.argwhere(wrong.reshape(flat.shape))[0])
        label = name if wrong.ndim == 1 else f"{name}_{column}"
        value = flat[row, column]
        found = "nothing" if np.isnan(value) else value  # NaN: an empty cell
        raise LogError(
            f"{self.path}: row {self.line(row)}, column {label}: found {found}, expected {expected}"
        )

    def loads(self, motions: bool = True) -> Loads:
        """Return the loads of the arm per row; ``motions`` False: without ``approach``."""
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
        approach = self.approach() if motions else None
        return Loads(**found, approach=approach, time=self.times())

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

        Without a column ``approach`` it is the sign of the change from the row before, or of the
        last change where a joint did not move.
        """
        if self.has("approach"):
            return np.sign(self.require("approach"))
        q = self.get("actual_q", "target_q")
        return None if q is None else last_motion(q)

    def same_rows(self, other: Log) -> bool:
        """Return whether both logs hold the same columns with the same numbers: a copy."""
        return self.columns.keys() == other.columns.keys() and all(
            np.array_equal(values, other.columns[name], equal_nan=True)
            for name, values in self.columns.items()
        )

    def select(self, rows: NDArray[Any] | slice) -> Log:
        """Return the log of some of the rows; each keeps the line that it had in the file."""
        lines = np.arange(len(self)) + self.first_row if self.lines is None else self.lines
        columns = {name: values[rows] for name, values in self.columns.items()}
        numbers = None if self.numbers is None else self.numbers[rows]
        return replace(self, columns=columns, lines=lines[rows], numbers=numbers)


def last_motion(q: Array) -> Array:
    """Return the sign (N, n) of the last change of each joint (rad) before each row."""
    sign = np.zeros(q.shape)
    change = np.diff(q, axis=0)
    sign[1:] = np.where(np.abs(change) > STILL, np.sign(change), 0)
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
        raise no_file(path)
    if path.suffix.lower() in PARQUET:
        file = ParquetColumns(path)
        names, lines, rows = file.names, None, file.rows
        read: Callable[[int], Array] = file.column
    else:
        names, table, lines = _read_csv(path)
        rows, read = len(table), partial(_column, table)
    if not rows:
        raise LogError(f"{path}: found no data rows, expected at least one")
    columns = grouped(path, [names[i] for i in wanted_of(names)], read, rows, n)
    if not columns:
        raise LogError(f"{path}: columns: found none that a log may hold{nearest(names)}")
    unknown = tuple(name for name in names if not is_known(name))
    counted = None if lines is None else np.arange(rows) + 1
    return Log(str(path), columns, n, unknown=unknown, lines=lines, numbers=counted)


def no_file(path: Path) -> LogError:
    """Return the error for a log that does not exist, or is a folder, a device or a pipe."""
    what = "found a device or pipe" if path.exists() else "file not found"
    if path.is_dir():
        what = "found a folder that is no data source"
    return LogError(f"{path}: {what}, expected a CSV or Parquet log")


def encoding_of(path: Path, head: bytes) -> str:
    """Return the text encoding of a log, by its first bytes.

    Raises LogError with the remedy where they are those of a compressed file.
    """
    for first, what in PACKED.items():
        if head.startswith(first):
            raise LogError(f"{path}: found {what}")
    return "utf-16" if head[:2] in UTF_16 else "utf-8-sig"


def text_of(path: Path) -> str:
    """Return the text of a log, unpacked where it is gzip. Raises LogError."""
    try:
        data = read_bytes(path)
        if data[:2] == GZIP:
            data = gzip.decompress(data)
        return data.decode(encoding_of(path, data)).replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise LogError(f"{path}: found bytes that are no text, expected CSV (UTF-8)") from None
    except (OSError, EOFError, zlib.error) as error:
        raise LogError(f"{path}: found no readable file ({error})") from None


def _read_csv(path: Path) -> tuple[list[str], Array, Index | None]:
    """Return the names of all columns, those that are known (rows, known columns), and the lines.

    Lines of the rows in the file, or None where they follow each other from 2. Lines that begin
    with # are comments, blank ones before the header are left out; with semicolons between the
    cells a comma may stand for the decimal point.
    """
    every = text_of(path).rstrip().split("\n")
    kept = [number for number, line in enumerate(every, start=1) if not is_comment(line)]
    kept = list(dropwhile(lambda number: not every[number - 1].strip(), kept))
    lines = [every[number - 1] for number in kept]
    if not lines:
        raise LogError(f"{path}: found an empty file, expected a CSV header")
    numbers = None if len(kept) == len(every) else np.array(kept[1:], dtype=np.int64)
    delimiter = delimiter_of(lines[0])
    names = [name.strip().strip('"') for name in lines[0].split(delimiter)]
    if len(lines) == 1:
        return names, np.empty((0, len(names))), numbers
    return names, csv_table(path, names, kept[1:], lines[1:], delimiter), numbers


def csv_table(
    path: Path, names: Sequence[str], numbers: Sequence[int], lines: Sequence[str], delimiter: str
) -> Array:
    """Return the known columns (rows, known columns) of lines, with their ``numbers`` in the file.

    Raises LogError where a line has not as many cells as there are names, or a cell is no number.
    """
    wanted = wanted_of(names)
    lines = [_one_cell_per_text(line, delimiter) if '"' in line else line for line in lines]
    for number, line in zip(numbers, lines, strict=True):
        if line.count(delimiter) != len(names) - 1:
            raise cell_count(path, number, line.count(delimiter) + 1, len(names))
    if not wanted:
        return np.empty((len(lines), 0))
    rows = [line.replace(",", ".") for line in lines] if delimiter == ";" else lines
    if len(names) > 1 or all(map(str.strip, lines)):  # numpy leaves out a blank line: a lone cell
        with contextlib.suppress(ValueError):
            return np.loadtxt(rows, delimiter=delimiter, usecols=wanted, ndmin=2, comments=None)
    return np.array([
        [cell_number(path, number, names[i], cell, delimiter) for i, cell in
         enumerate(line.split(delimiter)) if i in wanted]
        for number, line in zip(numbers, lines, strict=True)
    ])  # fmt: skip


def _one_cell_per_text(line: str, delimiter: str) -> str:
    """Return a line in which a text in quotes, such as a list of names, separates no cells."""
    return re.sub('"[^"]*"', lambda text: text[0].replace(delimiter, INSIDE), line)


def is_comment(line: str) -> bool:
    """Return whether a line of a CSV file is a comment."""
    return line.lstrip().startswith("#")


def delimiter_of(header: str) -> str:
    """Return the separator of a CSV file."""
    return ";" if header.count(";") > header.count(",") else ","


def cell_count(path: Path, row: int, found: int, expected: int) -> LogError:
    """Return the error of a row with another number of cells than the header."""
    more = " (decimal commas? then ; between the cells)" if found > expected else ""
    return LogError(
        f"{path}: row {row}: found {found} cells, expected {expected} as in the header{more}"
    )


def cell_number(path: Path, row: int, name: str, cell: str, delimiter: str) -> float:
    """Return the number in a cell, NaN where it is empty. Raises LogError naming row and column."""
    text = cell.strip().strip('"').replace(INSIDE, delimiter)
    try:
        if "_" in text:  # Python reads 1_0 as 10
            raise ValueError
        return float(text.replace(",", ".") if delimiter == ";" else text) if text else np.nan
    except ValueError:
        raise LogError(
            f"{path}: row {row}, column {name}: found {text!r}, expected a number"
        ) from None


def _column(table: Array, position: int) -> Array:
    return np.asarray(table[:, position])


def table_columns(path: Path, names: Sequence[str], table: Array, n: int) -> dict[str, Array]:
    """Return columns (N,) or (N, k) of a table (N, names), as ``grouped`` does."""
    return grouped(path, names, partial(_column, table), len(table), n)


def grouped(
    path: Path, names: Sequence[str], column: Callable[[int], Array], rows: int, n: int
) -> dict[str, Array]:
    """Return columns (rows,) or (rows, k) by name; ``column`` gives that of one of the ``names``.

    Raises LogError where a vector has a gap in its indices, or not its length.
    """
    found: dict[str, dict[int, int]] = {}
    columns: dict[str, Array] = {}
    for position, name in enumerate(names):
        if COLUMNS.get(name) == 0:
            if name in columns:
                raise LogError(f"{path}: column {name}: found twice, expected once")
            columns[name] = column(position).copy()  # a view would keep the whole table
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
        for index in range(expected):
            if index not in indices:
                first = f"; they count from {min(indices)} here" if min(indices) else ""
                raise LogError(f"{path}: column {name}_{index}: not found, expected {what}{first}")
        if len(indices) > expected:
            index = min(set(indices) - set(range(expected)))
            per = f" of a {n}-joint arm" if COLUMNS[name] is None else ""
            raise LogError(
                f"{path}: column {name}_{index}: found one too many, expected {what}{per}"
            )
        columns[name] = np.empty((rows, expected))
        for k in range(expected):
            columns[name][:, k] = column(indices[k])
    place = columns.get("measured_position", np.ones((1, 3)))
    nowhere = ~place.any(axis=1)
    if nowhere.sum() > 1:  # instruments give zeros without a target; the first may be the origin
        place[nowhere] = np.nan
    return columns
