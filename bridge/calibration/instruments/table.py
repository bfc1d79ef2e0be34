"""Readings in a text file: rows of numbers, with or without a line of names."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

from gapbridge.bridge.calibration.instruments.instrument import ReadingError
from gapbridge.bridge.calibration.instruments.numbers import numbers
from gapbridge.core.errors import InputError

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
