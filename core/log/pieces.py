"""Logs in pieces, for those that memory would not hold: Parquet, CSV, recordings of the daemon.

A piece is a Log of its own, whose rows keep the lines that they have in the file. What depends on
the rows before (the last motion of a joint) is carried over.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
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

# names of all columns, values of the known ones (rows, known columns), lines where not in sequence
Table = tuple[list[str], Array, Index | None]
ROWS = 16_384  # of a piece
RECORDING = ".mcap"


@dataclass(frozen=True)
class LogPieces:
    """A log that is read piece by piece, as often as it is iterated over."""

    path: Path
    n: int  # joints
    rows: int = ROWS  # of a piece at most (a recording: of a chunk)
    motions: bool = True  # False: without the last motions, which are carried from piece to piece

    def __iter__(self) -> Iterator[Log]:
        """Yield the pieces in order. Raises LogError, as ``read_log`` does."""
        motion = _Motion()
        first = 2
        for names, table, lines in _tables(self.path, self.rows):
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
        q = piece.columns.get("actual_q", piece.columns.get("target_q"))
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


def _tables(path: Path, rows: int) -> Iterator[Table]:
    """Yield the pieces of a file."""
    if not path.is_file():
        raise no_file(path)
    if path.suffix.lower() in PARQUET:
        columns = ParquetColumns(path)
        return ((columns.names, table, None) for table in columns.tables(rows))
    if path.suffix.lower() == RECORDING:
        return _recording(path)
    return _csv(path, rows, _encoding(path))


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


def _recording(path: Path) -> Iterator[Table]:
    from gapbridge.core.log.mcap_reading import read_batches

    for batch in read_batches(path):
        # what the controller never reported is no column
        reported = {
            name: values
            for name, values in batch.columns.items()
            if is_known(next(iter(scalars({name: values})))) and not np.isnan(values).all()
        }
        if reported:
            yield *as_table(reported), None
