"""Readings in text files that the instrument's software writes: one that grows, or many."""

from __future__ import annotations

import csv
import io
import time
from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    Samples,
    Where,
)
from gapbridge.bridge.calibration.instruments.numbers import coordinates, numbers
from gapbridge.bridge.cell.settings.instruments import ExportSettings, FileSettings, FolderSettings
from gapbridge.core.arrays import Array
from gapbridge.core.errors import InputError

E = TypeVar("E", bound=ExportSettings)
LOOK = 0.1  # s between two looks
WHOLE = 0.3  # s for which a file must not have grown
STOP = "stop"  # name of the column that says which stop of the plan a row belongs to


@dataclass(frozen=True)
class Row:
    """One row: its line in the file, from 1, its cells, and its stop where it reports one."""

    line: int
    cells: tuple[str, ...]
    stop: int | None


@dataclass(frozen=True)
class Table:
    """The whole lines of a file so far."""

    path: Path
    names: tuple[str, ...]  # empty: it has no line of names
    rows: tuple[Row, ...]

    def numbers(self, row: Row, columns: tuple[str, ...] | None, count: int) -> list[float]:
        """Return the numbers of a row's columns, by default its last ones.

        Raises ReadingError, naming file and row.
        """
        cells = row.cells[-count:] if columns is None else self._named(row, columns)
        try:
            return numbers(";".join(cells), count)
        except ReadingError as error:
            raise ReadingError(f"{self.path}: row {row.line}: {error}") from None

    def _named(self, row: Row, columns: tuple[str, ...]) -> tuple[str, ...]:
        missing = [name for name in columns if name not in self.names]
        if missing:
            raise InputError(
                f"{self.path}: column {missing[0]}: found none, expected one of "
                f"{', '.join(self.names) or 'a line of names'}"
            )
        return tuple(row.cells[self.names.index(name)] for name in columns)


def read_table(path: Path, growing: bool = True) -> Table:
    """Return a file's whole lines; an unfinished last line of a ``growing`` one does not count yet.

    Raises InputError where it is no text.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: found bytes that are no text, expected CSV (UTF-8)") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    whole = text[: text.rfind("\n") + 1] if growing else text
    first = whole.split("\n", 1)[0]
    separator = max(";\t,", key=first.count) if any(c in first for c in ";\t,") else " "
    lines = list(csv.reader(io.StringIO(whole), delimiter=separator, skipinitialspace=True))
    named = bool(lines) and any(not _is_number(c) for c in lines[0] if c.strip())
    names = tuple(c.strip() for c in lines[0]) if named else ()
    at = names.index(STOP) if STOP in names else None
    rows = []
    for i, cells in enumerate(lines[len(names) and 1 :], 1 + bool(names)):
        kept = tuple(c.strip() for c in cells if c.strip() or names)
        if not any(kept) or kept[0].startswith("#"):
            continue
        rows.append(Row(i, kept, _stop(path, i, kept, at)))
    return Table(path, names, tuple(rows))


def _stop(path: Path, line: int, cells: tuple[str, ...], at: int | None) -> int | None:
    if at is None:
        return None
    try:
        return int(cells[at])
    except (ValueError, IndexError):
        found = cells[at] if at < len(cells) else "nothing"
        raise InputError(
            f"{path}: row {line}, column {STOP}: found {found!r}, expected a whole number"
        ) from None


def _is_number(cell: str) -> bool:
    try:
        float(cell.strip().replace(",", "."))
    except ValueError:
        return False
    return True


class _Exported(Instrument[E]):
    """Waits for a reading that has not been had."""

    waits = True

    @abstractmethod
    def _look(self, where: Where) -> Samples | None:
        """Return the next reading, None where there is none yet. Raises ReadingError."""

    @abstractmethod
    def _nothing(self, where: Where) -> str:
        """Return what was not found in time, and what was expected."""

    def read(self, where: Where) -> Samples:
        """Return the next reading. Raises ReadingError where it is none or none comes in time."""
        until = time.monotonic() + self.settings.timeout
        while (found := self._look(where)) is None:
            if time.monotonic() > until:
                raise ReadingError(self._nothing(where))
            time.sleep(LOOK)
        return found

    def _coordinates(self, table: Table, row: Row) -> Array:
        return coordinates(
            table.numbers(row, self.settings.columns, self.settings.width), self.settings
        )


class File(_Exported[FileSettings]):
    """Takes the next row that has not been had, or, with a column ``stop``, the stop's last one."""

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

    def _nothing(self, where: Where) -> str:
        given = self.settings
        return f"{given.file}: found no new row for {given.timeout:g} s, expected stop {where.stop}"

    def _look(self, where: Where) -> Samples | None:
        if not self.settings.file.exists():
            return None
        table = read_table(self.settings.file)
        row = _next(table, where)
        if row is None:
            return None
        return Samples(self._coordinates(table, row)[np.newaxis], f"row {row.line}")


def _next(table: Table, where: Where) -> Row | None:
    rows = [r for r in table.rows if f"row {r.line}" not in where.used]
    if any(r.stop is not None for r in table.rows):
        own = [r for r in table.rows if r.stop == where.stop]
        return own[-1] if own else None
    return rows[0] if rows else None


class WatchedFolder(_Exported[FolderSettings]):
    """Takes the oldest file that came since the session began and has not been had.

    A file with several rows is several samples of one point.
    """

    @property
    def name(self) -> str:
        """Return the folder."""
        return f"files {self.settings.folder / self.settings.pattern} in {self.settings.unit}"

    def open(self) -> None:
        """Check that the folder is there. Raises InputError."""
        if not self.settings.folder.is_dir():
            raise InputError(
                f"{self.settings.folder}: found no such folder, expected the one that the "
                "tracker's software writes to"
            )

    def _nothing(self, where: Where) -> str:
        given, of = self.settings, self.settings.pattern
        return f"{given.folder}: found no new file for {given.timeout:g} s, expected {of}"

    def _look(self, where: Where) -> Samples | None:
        """Return the samples of the oldest new file, once it is whole."""
        came = []
        for path in self.settings.folder.glob(self.settings.pattern):
            try:
                at = path.stat().st_mtime
            except OSError:
                continue  # renamed or deleted meanwhile
            if path.is_file() and path.name not in where.used and at >= self.around.since:
                came.append((at, path.name, path))
        if not came:
            return None
        at, _, path = min(came)
        if time.time() - at <= WHOLE:
            return None
        table = read_table(path, growing=False)
        if not table.rows:
            raise ReadingError(f"{path}: found no row of numbers, expected one")
        return Samples(np.array([self._coordinates(table, row) for row in table.rows]), path.name)
