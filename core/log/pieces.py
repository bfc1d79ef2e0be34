"""Logs in pieces, for those that memory would not hold: Parquet, CSV, recordings of the daemon.

A piece is a Log of its own, whose rows keep the lines that they have in the file. What depends on
the rows before (the last motion of a joint) is carried over.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import dropwhile, islice
from pathlib import Path

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.errors import LogError
from gapbridge.core.log.columns import PARQUET, as_table, is_known, scalars
from gapbridge.core.log.log import (
    GZIP,
    Log,
    csv_table,
    delimiter_of,
    encoding_of,
    is_comment,
    last_motion,
    no_file,
    read_log,
    table_columns,
)
from gapbridge.core.log.parquet_tables import ParquetColumns
from gapbridge.core.notes import Note, Reason

# names of all columns, values of the known ones (rows, known columns), lines where not in sequence
Table = tuple[list[str], Array, Index | None]
ROWS = 16_384  # of a piece
RECORDING = ".mcap"
LOADS = ("actual_TCP_force", "payload", "payload_cog", "joint_temperatures")


@dataclass(frozen=True)
class LogPieces:
    """A log that is read piece by piece, as often as it is iterated over."""

    path: Path
    n: int  # joints
    rows: int = ROWS  # of a piece at most (a recording: of a chunk)
    motions: bool = True  # False: without the last motions, which are carried from piece to piece
    # ``reported_columns`` of the recording that the file is a part of; None: of the file itself
    reported: Collection[str] | None = None

    def __iter__(self) -> Iterator[Log]:
        """Yield the pieces in order. Raises LogError, as ``read_log`` does."""
        motion = _Motion()
        first = 2
        for names, table, lines in self._tables():
            known = [name for name in names if is_known(name)]
            columns = table_columns(self.path, known, table, self.n)
            if not columns:
                read_log(self.path, self.n)  # says what is wrong with it
            unknown = tuple(name for name in names if not is_known(name))
            numbers = np.arange(first - 1, first - 1 + len(table))
            piece = Log(
                str(self.path), columns, self.n, first, lines, unknown=unknown, numbers=numbers
            )
            yield motion.carried(piece) if self.motions else piece
            first += len(table)

    def _tables(self) -> Iterator[Table]:
        """Yield the pieces of the file."""
        path = self.path
        if not path.is_file():
            raise no_file(path)
        if path.suffix.lower() in PARQUET:
            columns = ParquetColumns(path)
            return ((columns.names, table, None) for table in columns.tables(self.rows))
        if path.suffix.lower() == RECORDING:
            reported = reported_columns(path) if self.reported is None else self.reported
            return _recording(path, reported)
        return _csv(path, self.rows, _encoding(path))

    def count(self) -> int:
        """Return the number of rows, from the file's metadata where it has it."""
        if self.path.suffix.lower() in PARQUET:
            return ParquetColumns(self.path).rows
        return sum(len(piece) for piece in self)


class _Motion:
    """The last motion of each joint, from piece to piece."""

    def __init__(self) -> None:
        self._q: Array | None = None  # (1, n) the last row
        self._sign: Array | None = None  # (n,)

    def carried(self, piece: Log) -> Log:
        """Return the piece with its column ``approach``, where the log itself lacks one."""
        q = piece.get("actual_q", "target_q")
        if piece.has("approach") or q is None:
            return piece
        if self._q is None or self._sign is None:
            sign = last_motion(q)
        else:
            sign = last_motion(np.vstack([self._q, q]))[1:]
            unmoved = np.cumsum(np.abs(sign), axis=0) == 0
            sign = np.where(unmoved, self._sign, sign)
        self._q, self._sign = q[-1:].copy(), sign[-1].copy()
        return replace(piece, columns={**piece.columns, "approach": sign})


def column_names(path: Path) -> list[str]:
    """Return the names of all columns of a CSV or Parquet file.

    Raises LogError where they cannot be read, or where a CSV is packed.
    """
    if path.suffix.lower() in PARQUET:
        return ParquetColumns(path).names
    with path.open(encoding=_encoding(path)) as file:
        return _header(_rows(path, file))[0]


def _encoding(path: Path) -> str:
    """Return the text encoding of a CSV. Raises LogError where it is packed."""
    with path.open("rb") as file:
        head = file.read(8)
    if head[:2] == GZIP:
        raise LogError(
            f"{path}: found gzip of a log that is too long to be read as a whole, expected it "
            "unpacked (gunzip)"
        )
    return encoding_of(path, head)


def _rows(path: Path, file: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Yield the header and the rows of a CSV with their lines. Raises LogError if it is no text."""
    try:
        yield from dropwhile(lambda one: not one[1].strip(), _lines(file))
    except UnicodeDecodeError:
        raise LogError(f"{path}: found bytes that are no text, expected CSV (UTF-8)") from None


def _header(rows: Iterator[tuple[int, str]]) -> tuple[list[str], str]:
    """Return the names of all columns, and the delimiter, of the first of the rows."""
    header = next(rows, (1, ""))[1]
    delimiter = delimiter_of(header)
    return [name.strip().strip('"') for name in header.strip().split(delimiter)], delimiter


def _csv(path: Path, rows: int, encoding: str) -> Iterator[Table]:
    with path.open(encoding=encoding) as file:
        kept = _rows(path, file)
        names, delimiter = _header(kept)
        while taken := list(islice(kept, rows)):
            numbers, lines = zip(*taken, strict=True)
            table = csv_table(
                path, names, numbers, [line.rstrip("\r\n") for line in lines], delimiter
            )
            yield names, table, np.array(numbers, dtype=np.int64)


def _lines(file: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Yield the lines of a file with their numbers, without comments and blank ones at the end."""
    blank = []
    for number, line in enumerate(file, start=1):
        if not line.strip():
            blank.append((number, line))
        elif not is_comment(line):
            yield from blank
            blank.clear()
            yield number, line


def reported_columns(recording: Path) -> dict[str, int]:
    """Return the columns of a recording that have any value, and how many rows of each lack one.

    What the controller never reported is no column. Decided for the recording as a whole: within
    one chunk (0.4 s) a sensor may be silent. Rows without a load are no rows of the log. Holds one
    chunk at a time. Raises LogError.
    """
    from gapbridge.core.log.mcap_reading import read_batches

    missing: dict[str, int] = {}
    carried: set[str] = set()
    for batch in read_batches(recording):
        columns = _known(batch.columns)
        carried.update(name for name in columns if _has_values(columns[name]))
        if any(map(_has_values, columns.values())):  # others are no rows of the log
            for name, values in columns.items():
                without = np.isnan(values).reshape(len(values), -1).any(axis=1)
                missing[name] = missing.get(name, 0) + int(without.sum())
    return {name: rows for name, rows in missing.items() if name in carried}


def missing_values(reported: Mapping[str, int]) -> tuple[Note, ...]:
    """Return a note for each of ``reported_columns`` that lacks values."""
    return tuple(Note(Reason.MISSING, (rows, name)) for name, rows in reported.items() if rows)


def _known(columns: Mapping[str, Array]) -> dict[str, Array]:
    """Return the fields of a recording that are columns of a log."""
    return {
        name: values
        for name, values in columns.items()
        if is_known(next(iter(scalars({name: values}))))
    }


def _has_values(values: Array) -> bool:
    return not np.isnan(values).all()


def _recording(path: Path, reported: Collection[str]) -> Iterator[Table]:
    from gapbridge.core.log.mcap_reading import read_batches

    for batch in read_batches(path):
        columns = {name: values for name, values in batch.columns.items() if name in reported}
        # a lost sensor: what bends the arm is not known
        known = [~np.isnan(columns[k].reshape(len(batch), -1)).any(axis=1)
                 for k in LOADS if k in columns]  # fmt: skip
        rows = np.logical_and.reduce(known) if known else np.full(len(batch), True)
        columns = {name: values[rows] for name, values in columns.items()}
        if any(map(_has_values, columns.values())):
            yield *as_table(columns), None
