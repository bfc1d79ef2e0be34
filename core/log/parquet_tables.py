"""Parquet files as tables of numbers, whole or in pieces."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LogError
from gapbridge.core.files import is_given, read_bytes
from gapbridge.core.log.columns import wanted_of

if TYPE_CHECKING:
    import pyarrow

BUFFER = 1 << 18  # bytes of each column that are read ahead


class ParquetColumns:
    """The columns of a Parquet file that a log may hold, read when asked for; NaN: missing.

    Raises LogError where the file cannot be read, or a column is none of numbers.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with _named(path):
            self._file = _opened(path)
        self.names: list[str] = list(self._file.schema_arrow.names)
        self.wanted = [self.names[i] for i in wanted_of(self.names)]
        self.rows = int(self._file.metadata.num_rows)
        _check_types(path, self._file.schema_arrow, self.wanted)

    def column(self, position: int) -> Array:
        """Return one of the wanted columns (N,)."""
        import pyarrow

        with _named(self._path):
            name = self.wanted[position]
            values = _numbers(self._file.read([name], use_threads=False), name)
            pyarrow.default_memory_pool().release_unused()
            return values

    def tables(self, rows: int) -> Iterator[Array]:
        """Yield the wanted columns (rows, wanted), so many rows at a time.

        Fortran-ordered: each column lies in one place.
        """
        import pyarrow

        with _named(self._path):
            for part in self._file.iter_batches(rows, columns=self.wanted, use_threads=False):
                table = np.empty((part.num_rows, len(self.wanted)), order="F")
                for k, name in enumerate(self.wanted):
                    table[:, k] = _numbers(part, name)
                yield table
            pyarrow.default_memory_pool().release_unused()


def _opened(path: Path) -> pyarrow.parquet.ParquetFile:
    import pyarrow  # only where there is Parquet
    from pyarrow.parquet import ParquetFile

    # pyarrow's own files take no name that is not UTF-8, unless it is bytes
    given = pyarrow.BufferReader(read_bytes(path)) if is_given() else pyarrow.OSFile(bytes(path))
    # not ahead of what is asked for: whole columns would be
    return ParquetFile(given, buffer_size=BUFFER, pre_buffer=False)


def _numbers(part: pyarrow.Table | pyarrow.RecordBatch, name: str) -> Array:
    import pyarrow

    column = part.column(name)
    if column.type != pyarrow.float64():
        try:
            column = column.cast(pyarrow.float64())  # imports what costs 40 ms
        except pyarrow.ArrowInvalid as error:
            raise pyarrow.ArrowInvalid(f"column {name}: {error}") from None
    return np.asarray(column.to_numpy(zero_copy_only=False))


@contextmanager
def _named(path: Path) -> Iterator[None]:
    import pyarrow

    try:
        yield
    except (pyarrow.ArrowException, OSError) as error:
        raise LogError(f"{path}: found no readable Parquet file ({error})") from None


def _check_types(path: Path, schema: pyarrow.Schema, wanted: list[str]) -> None:
    from pyarrow import types

    for name in wanted:
        if len(schema.get_all_field_indices(name)) > 1:
            raise LogError(f"{path}: column {name}: found twice, expected it once")
        kind = schema.field(name).type
        if not (types.is_floating(kind) or types.is_integer(kind) or types.is_decimal(kind)):
            what = "text" if types.is_string(kind) else str(kind)
            raise LogError(f"{path}: column {name}: found {what}, expected numbers")
