"""A CSV file in which the readings stand or into which they come, row by row."""

from __future__ import annotations

import time

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    Samples,
    Where,
)
from gapbridge.bridge.calibration.instruments.numbers import coordinates
from gapbridge.bridge.calibration.instruments.table import Row, Table, read_table
from gapbridge.bridge.cell.settings.instruments import FileSettings
from gapbridge.core.errors import InputError

LOOK = 0.1  # s between two looks at the file


class File(Instrument[FileSettings]):
    """Takes the next row that has not been had, or, with a column ``stop``, the stop's last one."""

    waits = True

    @property
    def name(self) -> str:
        """Return the file."""
        return f"readings from {self.settings.file} in {self.settings.unit}"

    def open(self) -> None:
        """Check that the file, or at least its folder, is there. Raises InputError."""
        file = self.settings.file
        if file.is_dir() or not file.parent.is_dir():
            raise InputError(f"{file}: found no such file, expected the instrument's CSV")
        if file.exists():
            read_table(file)

    def read(self, where: Where) -> Samples:
        """Return one sample. Raises ReadingError where it is none or does not come in time."""
        given, until = self.settings, time.monotonic() + self.settings.timeout
        while True:
            table = read_table(given.file) if given.file.exists() else None
            row = None if table is None else _next(table, where)
            if table is not None and row is not None:
                values = table.numbers(row, given.columns, given.width)
                return Samples(coordinates(values, given)[np.newaxis], f"row {row.line}")
            if time.monotonic() > until:
                raise ReadingError(
                    f"{given.file}: found no new row for {given.timeout:g} s, expected stop "
                    f"{where.stop}"
                )
            time.sleep(LOOK)


def _next(table: Table, where: Where) -> Row | None:
    rows = [r for r in table.rows if f"row {r.line}" not in where.used]
    if any(r.stop is not None for r in table.rows):
        own = [r for r in table.rows if r.stop == where.stop]
        return own[-1] if own else None
    return rows[0] if rows else None
