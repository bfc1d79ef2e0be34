"""Logs read in pieces: recordings, and files of more than LARGE_ROWS rows."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.opened_log import check_log, open_log, show_notes
from gapbridge.core.effects import by_approach
from gapbridge.core.errors import LogError
from gapbridge.core.log.columns import PARQUET
from gapbridge.core.log.log import Log
from gapbridge.core.log.pieces import (
    ROWS,
    LogPieces,
    column_names,
    missing_values,
    reported_columns,
)
from gapbridge.core.log.sources import source_of
from gapbridge.core.log.sources.recording import Recording

PIECE_ROWS = 65_536  # of a piece whose rows are processed independently
LARGE_ROWS = 20_000
LARGE_BYTES = 8_000_000  # of a text file with about LARGE_ROWS


@dataclass(frozen=True)
class LargeLog:
    """The pieces of a log, each checked for a cell's arm."""

    path: Path
    cell: Cell
    motions: bool = True  # see LogPieces
    rows: int = ROWS  # of a piece

    def __iter__(self) -> Iterator[Log]:
        """Yield the pieces. Raises LogError, as ``open_log`` does."""
        files, reported = [self.path], None
        if source_of(self.path) is not None:
            from gapbridge.core.log.mcap_reading import damages, files_of  # imports protobuf

            files = files_of(self.path)
            reported = reported_columns(self.path)
            show_notes(self.path, (*damages(self.path), *missing_values(reported)))
        empty = True
        for file in files:
            for piece in LogPieces(file, self.cell.arm.n, self.rows, self.motions, reported):
                check_log(piece, self.cell)
                empty = False
                yield piece
        if empty:
            open_log(self.path, self.cell)  # says what is wrong with it


def pieces_of(path: Path, cell: Cell) -> Iterable[Log]:
    """Return a log in pieces; a small log, or another program's recording, is one piece.

    Raises LogError, as ``open_log`` does.
    """
    if source_of(path) is None and is_large(path):
        return LargeLog(path, cell, by_approach(cell.model.terms), PIECE_ROWS)
    return [open_log(path, cell)]


def is_large(path: Path) -> bool:
    """Return whether a log is to be read in pieces. Raises LogError if it cannot be read."""
    source = source_of(path)
    if source is not None:
        return source.identifier == Recording.identifier
    if not path.is_file():
        return False
    if path.suffix.lower() not in PARQUET:
        return path.stat().st_size > LARGE_BYTES
    import pyarrow

    try:
        return LogPieces(path, 0).count() > LARGE_ROWS
    except (pyarrow.ArrowException, OSError) as error:
        raise LogError(f"{path}: found no readable Parquet file ({error})") from None


def has_sessions(path: Path) -> bool:
    """Return whether a log's rows belong to several sessions (a column ``session``).

    Raises LogError if its columns cannot be read.
    """
    if source_of(path) is not None or not path.is_file():
        return False
    return "session" in column_names(path)
