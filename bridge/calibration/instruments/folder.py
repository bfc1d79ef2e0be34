"""A folder into which the tracker's software exports one file a reading."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    Samples,
    Where,
)
from gapbridge.bridge.calibration.instruments.numbers import coordinates
from gapbridge.bridge.calibration.instruments.table import read_table
from gapbridge.bridge.cell.settings.instruments import FolderSettings
from gapbridge.core.errors import InputError

LOOK = 0.1  # s between two looks into the folder
WHOLE = 0.3  # s for which a file must not have grown


class WatchedFolder(Instrument[FolderSettings]):
    """Takes the oldest file that came since the session began and has not been had.

    A file with several rows is several samples of one point.
    """

    waits = True

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

    def read(self, where: Where) -> Samples:
        """Return a file's samples. Raises ReadingError where it has none or none comes in time."""
        given, until = self.settings, time.monotonic() + self.settings.timeout
        while True:
            found = self._next(where.used)
            if found is not None:
                return self._samples(found)
            if time.monotonic() > until:
                raise ReadingError(
                    f"{given.folder}: found no new file for {given.timeout:g} s, expected "
                    f"{given.pattern}"
                )
            time.sleep(LOOK)

    def _next(self, used: frozenset[str]) -> Path | None:
        """Return the oldest new file, once it is whole."""
        came = []
        for path in self.settings.folder.glob(self.settings.pattern):
            try:
                at = path.stat().st_mtime
            except OSError:
                continue  # renamed or deleted meanwhile
            if path.is_file() and path.name not in used and at >= self.around.since:
                came.append((at, path.name, path))
        if not came:
            return None
        at, _, path = min(came)
        return path if time.time() - at > WHOLE else None

    def _samples(self, path: Path) -> Samples:
        given = self.settings
        table = read_table(path, growing=False)
        if not table.rows:
            raise ReadingError(f"{path}: found no row of numbers, expected one")
        rows = [table.numbers(row, given.columns, given.width) for row in table.rows]
        return Samples(np.array([coordinates(row, given) for row in rows]), path.name)
