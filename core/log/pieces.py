"""Logs in pieces, for those that memory would not hold: Parquet, CSV, recordings of the daemon.

A piece is a Log of its own, whose rows keep the lines that they have in the file. What depends on
the rows before (the last motion of a joint) is carried over.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.errors import LogError
from gapbridge.core.log.columns import is_known
from gapbridge.core.log.log import (
    GZIP,
    Log,
    cell_count,
    cell_number,
    delimiter_of,
    is_comment,
    last_motion,
    read_log,
    table_columns,
)

Array = NDArray[np.float64]
ROWS = 16_384  # of a piece
RECORDING = ".mcap"
PARQUET = (".parquet", ".pq")


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
        for names, table in _tables(self.path, self.rows):
            known = [name for name in names if is_known(name)]
            columns = table_columns(self.path, known, table, self.n)
            if not columns:
                read_log(self.path, self.n)  # says what is wrong with it
            unknown = tuple(name for name in names if not is_known(name))
            piece = Log(str(self.path), columns, self.n, first, unknown=unknown)
            yield motion.carried(piece) if self.motions else piece
            first += len(table)

    def count(self) -> int:
        """Return how many rows the log has, without reading them where the file says it."""
        if self.path.suffix.lower() in PARQUET:
            from pyarrow import parquet

            return int(parquet.ParquetFile(self.path).metadata.num_rows)
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


def _tables(path: Path, rows: int) -> Iterator[tuple[list[str], Array]]:
    """Yield the names of all columns and the known ones' values (rows, known columns)."""
    if not path.is_file():
        raise LogError(f"{path}: file not found, expected a CSV or Parquet log")
    if path.suffix.lower() in PARQUET:
        return _parquet(path, rows)
    if path.suffix.lower() == RECORDING:
        return _recording(path)
    with path.open("rb") as file:
        if file.read(2) == GZIP:
            raise LogError(
                f"{path}: found gzip of a log that is too long to be read as a whole, expected it "
                "unpacked (gunzip)"
            )
    return _csv(path, rows)


def _parquet(path: Path, rows: int) -> Iterator[tuple[list[str], Array]]:
    import pyarrow
    from pyarrow import parquet

    try:
        file = parquet.ParquetFile(path)
        names = list(file.schema_arrow.names)
        wanted = [name for name in names if is_known(name)]
        for batch in file.iter_batches(batch_size=rows, columns=wanted):
            table = np.empty((batch.num_rows, len(wanted)))
            for k, name in enumerate(wanted):
                values = batch.column(name).cast(pyarrow.float64())
                table[:, k] = values.to_numpy(zero_copy_only=False)
            yield names, table
    except pyarrow.ArrowException as error:
        raise LogError(f"{path}: found no readable Parquet file of numbers ({error})") from None


def _csv(path: Path, rows: int) -> Iterator[tuple[list[str], Array]]:
    with path.open(encoding="utf-8-sig") as file:
        kept = ((k, line) for k, line in enumerate(file, start=1) if not is_comment(line))
        header = next(kept, (1, ""))[1]
        delimiter = delimiter_of(header)
        names = [name.strip().strip('"') for name in header.strip().split(delimiter)]
        wanted = [k for k, name in enumerate(names) if is_known(name)]
        while lines := list(islice(kept, rows)):
            table = np.empty((len(lines), len(wanted)))
            for k, (number, line) in enumerate(lines):
                cells = line.strip().split(delimiter)
                if len(cells) != len(names):
                    raise cell_count(path, number, len(cells), len(names))
                table[k] = [
                    cell_number(path, number, names[c], cells[c], delimiter) for c in wanted
                ]
            yield names, table


def _recording(path: Path) -> Iterator[tuple[list[str], Array]]:
    from gapbridge.core.log.mcap_reading import read_batches

    for batch in read_batches(path):
        names, parts = [], []
        for name, values in batch.columns.items():
            flat = values.reshape(len(values), -1)
            ends = [""] if values.ndim == 1 else [f"_{k}" for k in range(flat.shape[1])]
            # what the controller never reported is no column
            if len(values) and is_known(name + ends[0]) and not np.isnan(flat).all():
                names += [name + end for end in ends]
                parts.append(flat)
        if parts:
            yield names, np.hstack(parts)
