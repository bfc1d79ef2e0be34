"""Watches for the mark that a failed verification leaves beside the cell."""

from __future__ import annotations

import os.path
from pathlib import Path

from gapbridge.bridge.cell.verification_mark import read_mark, remove_mark
from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.core.errors import RunError


class VerificationWatch:
    """Reports when the mark of a cell comes, changes or goes; None: there is no cell to watch."""

    def __init__(self, cell: Path | None) -> None:
        self._cell = cell
        self._reason = ""  # of the mark that was reported last; empty: none
        self.problem = ""  # why an acknowledged mark is still there

    def look(self) -> Event | None:
        """Return an event if the mark has come, changed or gone since the last call."""
        if self._cell is None:
            return None
        reason = read_mark(self._cell)
        if reason == self._reason or (not reason and not os.path.exists(self._cell)):
            return None  # without the cell its folder is away: that passes no verification
        before, self._reason = self._reason, reason
        detail = reason or f"acknowledged or verified again: {before}"
        return {"kind": EventKind.VERIFICATION, "holds": not reason, "detail": detail}

    def acknowledge(self) -> None:
        """Remove the mark that was reported last; a newer one stays."""
        self.problem = ""
        if self._cell is None or not self._reason or read_mark(self._cell) != self._reason:
            return
        try:
            remove_mark(self._cell)
        except RunError as error:
            self.problem = str(error)
