"""Readings from text files of the instrument's software: one growing file, or one per reading."""

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
    ReadRequest,
    Samples,
)
from gapbridge.bridge.calibration.instruments.numbers import check_header, parse_numbers, to_si
from gapbridge.bridge.cell.settings.instruments import ExportSettings, FileSettings, FolderSettings
from gapbridge.core.arrays import Array
from gapbridge.core.errors import InputError

E = TypeVar("E", bound=ExportSettings)
POLL_INTERVAL = 0.1  # s
UNCHANGED_FOR = 0.3  # s without a change after which a file counts as complete
STOP_COLUMN = "stop"  # optional: number of the stop (from 1) that a row belongs to


@dataclass(frozen=True)
class Row:
    """One row of a file."""

    line: int  # number in the file, from 1
    cells: tuple[str, ...]
    stop: int | None  # from 1; None: no column ``stop``

    @property
    def source(self) -> str:
        """Return the row's name; of a stop's row with its text, so that a corrected one is new."""
        text = "" if self.stop is None else f": {' '.join(self.cells)}"
        return f"row {self.line}{text}"


@dataclass(frozen=True)
class Table:
    """The complete lines of a file so far."""

    path: Path
    names: tuple[str, ...]  # of the columns; empty: the file has no header
    rows: tuple[Row, ...]

    def values(self, row: Row, settings: ExportSettings) -> list[float]:
        """Return the numbers of a row's reading: the named columns, by default the last ones.

        Raises ReadingError naming file and row, also for another unit than the declared one;
        InputError for an unknown column.
        """
        columns, count = settings.columns, settings.width
        titled = self.names and self.names[0].startswith("#")  # a comment, perhaps no header
        if self.names and len(row.cells) != len(self.names) and (columns or not titled):
            raise ReadingError(  # which of its cells it lacks is unknown: the others would shift
                f"{self.path}: row {row.line}: found {len(row.cells)} cells, expected "
                f"{len(self.names)} as in the header"
            )
        cells = row.cells[-count:] if columns is None else self._select(row, columns)
        try:
            for name in self.names[-count:] if columns is None else columns:
                check_header(name, settings.units)
        except ReadingError as error:
            raise InputError(f"{self.path}: column {name}: {error}") from None
        try:
            return parse_numbers(";".join(cells), count, *settings.units)
        except ReadingError as error:
            raise ReadingError(f"{self.path}: row {row.line}: {error}") from None

    def _select(self, row: Row, columns: tuple[str, ...]) -> tuple[str, ...]:
        missing = [name for name in columns if name not in self.names]
        if missing:
            raise InputError(
                f"{self.path}: column {missing[0]}: found none, expected one of "
                f"{', '.join(self.names) or 'a header'}"
            )
        twice = [name for name in columns if self.names.count(name) > 1]
        if twice:  # nominal and measured, for instance
            raise InputError(f"{self.path}: column {twice[0]}: found it twice, expected it once")
        return tuple(row.cells[self.names.index(name)] for name in columns)


def read_table(path: Path, growing: bool = True) -> Table:
    """Return the complete lines of a file; of a ``growing`` one without an unterminated last line.

    Raises InputError if it cannot be read, is no UTF-8 or no CSV, or a stop is no whole number.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise InputError(f"{path}: found bytes that are no text, expected CSV (UTF-8)") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    complete = text[: text.rfind("\n") + 1] if growing else text
    first = complete.split("\n", 1)[0]
    separator = max(";\t,", key=first.count) if any(c in first for c in ";\t,") else " "
    try:
        lines = list(csv.reader(io.StringIO(complete), delimiter=separator, skipinitialspace=True))
    except csv.Error as error:
        raise InputError(f"{path}: found {error}, expected CSV") from None
    has_header = bool(lines) and any(not _is_number(c) for c in lines[0] if c.strip())
    names = _cells(lines[0], 0) if has_header else ()
    stop_index = names.index(STOP_COLUMN) if STOP_COLUMN in names else None
    rows = []
    for i, cells in enumerate(lines[len(names) and 1 :], 1 + bool(names)):
        kept = _cells(cells, len(names)) if names else tuple(c.strip() for c in cells if c.strip())
        if not any(kept) or kept[0].startswith("#"):
            continue
        rows.append(Row(i, kept, _stop(path, i, kept, stop_index)))
    return Table(path, names, tuple(rows))


def _cells(cells: list[str], count: int) -> tuple[str, ...]:
    """Return the cells of a row, without empty ones beyond ``count``: a separator at its end."""
    kept = [cell.strip() for cell in cells]
    while len(kept) > count and not kept[-1]:
        kept.pop()
    return tuple(kept)


def _stop(path: Path, line: int, cells: tuple[str, ...], index: int | None) -> int | None:
    if index is None:
        return None
    try:
        return int(cells[index])
    except (ValueError, IndexError):
        text = cells[index] if index < len(cells) else "nothing"
        raise InputError(
            f"{path}: row {line}, column {STOP_COLUMN}: found {text!r}, expected a whole number"
        ) from None


def _is_number(cell: str) -> bool:
    try:
        float(cell.strip().replace(",", "."))
    except ValueError:
        return False
    return True


class _ExportedReadings(Instrument[E]):
    """Waits for a reading that the session has not used yet."""

    self_triggered = True

    @abstractmethod
    def _poll(self, request: ReadRequest) -> Samples | None:
        """Return the next reading, None if there is none yet. Raises ReadingError."""

    @abstractmethod
    def _timeout_message(self, request: ReadRequest) -> str:
        """Return the message for a reading that did not arrive within ``settings.timeout``."""

    def read(self, request: ReadRequest) -> Samples:
        """Return the next reading. Raises ReadingError if it is invalid or none arrives in time."""
        until = time.monotonic() + self.settings.timeout
        while (samples := self._poll(request)) is None:
            if time.monotonic() > until:
                raise ReadingError(self._timeout_message(request))
            time.sleep(POLL_INTERVAL)
        return samples

    def _coordinates(self, table: Table, row: Row) -> Array:
        return to_si(table.values(row, self.settings), self.settings)


class ReadingsFile(_ExportedReadings[FileSettings]):
    """Reads the next unused row of a CSV file; with a column ``stop``, the last row of a stop."""

    @property
    def name(self) -> str:
        """Return the file and its unit."""
        return f"readings from {self.settings.file} in {self.settings.unit}"

    def open(self) -> None:
        """Check that the file, or at least its folder, exists. Raises InputError."""
        file = self.settings.file
        if file.is_dir() or not file.parent.is_dir():
            raise InputError(f"{file}: found no such file, expected the instrument's CSV")
        if file.exists():
            read_table(file)

    def earlier(self, live: bool) -> tuple[str, ...]:
        """Return the rows that are there already: all of a file from before the session."""
        file = self.settings.file
        if not file.exists() or not (live or file.stat().st_mtime < self.context.since):
            return ()
        return tuple(row.source for row in read_table(file).rows)

    def _timeout_message(self, request: ReadRequest) -> str:
        file, timeout = self.settings.file, self.settings.timeout
        return f"{file}: found no new row for {timeout:g} s, expected stop {request.stop}"

    def _poll(self, request: ReadRequest) -> Samples | None:
        if not self.settings.file.exists():
            return None
        table = read_table(self.settings.file)
        row = _next_row(table, request)
        if row is None:
            return None
        return Samples(self._coordinates(table, row)[np.newaxis], row.source)


def _next_row(table: Table, request: ReadRequest) -> Row | None:
    if any(r.stop is not None for r in table.rows):  # its last row; an earlier one was replaced
        rows = [r for r in table.rows if r.stop == request.stop][-1:]
    else:
        rows = list(table.rows)
    return next((r for r in rows if r.source not in request.used), None)


class WatchedFolder(_ExportedReadings[FolderSettings]):
    """Reads the oldest unused file of a folder that was written since the session began.

    The rows of one file are samples of one point.
    """

    @property
    def name(self) -> str:
        """Return the file pattern and its unit."""
        return f"files {self.settings.folder / self.settings.pattern} in {self.settings.unit}"

    def open(self) -> None:
        """Check that the folder exists. Raises InputError."""
        if not self.settings.folder.is_dir():
            raise InputError(
                f"{self.settings.folder}: found no such folder, expected the one that the "
                "tracker's software writes to"
            )

    def earlier(self, live: bool) -> tuple[str, ...]:
        """Return the files that are there already; older ones than the session are never read."""
        folder, pattern = self.settings.folder, self.settings.pattern
        return tuple(sorted(path.name for path in folder.glob(pattern))) if live else ()

    def _timeout_message(self, request: ReadRequest) -> str:
        folder, pattern = self.settings.folder, self.settings.pattern
        return f"{folder}: found no new file for {self.settings.timeout:g} s, expected {pattern}"

    def _poll(self, request: ReadRequest) -> Samples | None:
        """Return the samples of the oldest new file once it is complete."""
        new_files = []
        for path in self.settings.folder.glob(self.settings.pattern):
            try:
                modified = path.stat().st_mtime
            except OSError:
                continue  # renamed or deleted meanwhile
            unused = path.is_file() and path.name not in request.used
            if unused and modified >= self.context.since:
                new_files.append((modified, path.name, path))
        if not new_files:
            return None
        modified, _, path = min(new_files)
        if time.time() - modified <= UNCHANGED_FOR:
            return None
        table = read_table(path, growing=False)
        if not table.rows:
            raise ReadingError(f"{path}: found no row of numbers, expected one")
        return Samples(np.array([self._coordinates(table, row) for row in table.rows]), path.name)
