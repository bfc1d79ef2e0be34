"""Logs that a command takes in pieces: recordings, and files of more rows than LARGE."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.opened_log import check_log, open_log
from gapbridge.core.effects import by_approach
from gapbridge.core.errors import LogError
from gapbridge.core.log.columns import PARQUET
from gapbridge.core.log.log import Log
from gapbridge.core.log.pieces import ROWS, LogPieces
from gapbridge.core.log.sources import source_of
from gapbridge.core.log.sources.recording import Recording

AT_ONCE = 65_536  # rows of a piece where nothing but the piece's own result is kept
LARGE = 20_000  # rows from which a log is read in pieces
BYTES = 8_000_000  # of a text file that holds about as many


@dataclass(frozen=True)
class LargeLog:
    """The pieces of a log, each checked for a cell's arm."""

    path: Path
    cell: Cell
    motions: bool = True  # see LogPieces
    rows: int = ROWS  # of a piece

    def __iter__(self) -> Iterator[Log]:
        """Yield the pieces. Raises LogError, as ``open_log`` does."""
        files = [self.path]
        if not self.path.is_file():
            from gapbridge.core.log.mcap_reading import files_of  # brings protobuf

            files = files_of(self.path)
        for file in files:
            for piece in LogPieces(file, self.cell.arm.n, self.rows, self.motions):
                check_log(piece, self.cell)
                yield piece


def pieces_of(path: Path, cell: Cell) -> Iterable[Log]:
    """Return a log for a cell's arm in pieces; what another program wrote, or is small, as one.

    Raises LogError, as ``open_log`` does.
    """
    if source_of(path) is None and is_large(path):
        return LargeLog(path, cell, by_approach(cell.model.terms), AT_ONCE)
    return [open_log(path, cell)]


def is_large(path: Path) -> bool:
    """Return whether a log is to be read in pieces. Raises LogError where it cannot be read."""
    source = source_of(path)
    if source is not None:
        return source.identifier == Recording.identifier
    if not path.is_file():
        return False
    if path.suffix.lower() not in PARQUET:
        return path.stat().st_size > BYTES
    import pyarrow

    try:
        return LogPieces(path, 0).count() > LARGE
    except (pyarrow.ArrowException, OSError) as error:
        raise LogError(f"{path}: found no readable Parquet file ({error})") from None


def has_sessions(path: Path) -> bool:
    """Return whether a log's rows belong to several sessions (a column ``session``)."""
    if source_of(path) is not None or not path.is_file():
        return False
    if path.suffix.lower() in PARQUET:
        from pyarrow import parquet

        return "session" in parquet.read_schema(path).names
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        header = file.readline().replace(";", ",").strip().split(",")
    return "session" in [name.strip().strip('"') for name in header]
