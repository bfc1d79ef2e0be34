"""Parquet files as tables of numbers, whole or in pieces."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.errors import LogError
from gapbridge.core.files import is_given, read_bytes
from gapbridge.core.log.columns import wanted_of

if TYPE_CHECKING:
    import pyarrow

Array = NDArray[np.float64]
BUFFER = 1 << 18  # bytes of each column that are read ahead


def parquet_tables(path: Path, rows: int | None = None) -> Iterator[tuple[list[str], Array]]:
    """Yield the names of all columns, and those that a log may hold (rows, known columns).

    ``rows`` at a time; None: all at once. A missing number is NaN. The tables are Fortran-ordered:
    each column lies in one place. Raises LogError where the file cannot be read, or a column is
    none of numbers.
    """
    import pyarrow  # only where there is Parquet
    from pyarrow.parquet import ParquetFile

    try:
        given = pyarrow.BufferReader(read_bytes(path)) if is_given() else path
        # not ahead of what is asked for: whole columns would be
        file = ParquetFile(given, buffer_size=BUFFER, pre_buffer=False)
        names = list(file.schema_arrow.names)
        wanted = [names[i] for i in wanted_of(names)]
        _check_types(path, file.schema_arrow, wanted)
        parts = (
            [file.read(wanted)]
            if rows is None
            else file.iter_batches(rows, columns=wanted, use_threads=False)
        )
        for part in parts:
            table = np.empty((part.num_rows, len(wanted)), order="F")
            for k, name in enumerate(wanted):
                table[:, k] = (
                    part.column(name).cast(pyarrow.float64()).to_numpy(zero_copy_only=False)
                )
            yield names, table
        pyarrow.default_memory_pool().release_unused()
    except (pyarrow.ArrowException, OSError) as error:
        raise LogError(f"{path}: found no readable Parquet file ({error})") from None


def _check_types(path: Path, schema: pyarrow.Schema, wanted: list[str]) -> None:
    from pyarrow import types

    for name in wanted:
        kind = schema.field(name).type
        if not (types.is_floating(kind) or types.is_integer(kind) or types.is_decimal(kind)):
            what = "text" if types.is_string(kind) else str(kind)
            raise LogError(f"{path}: column {name}: found {what}, expected numbers")
