"""Watches for the mark that a failed verification leaves beside the cell."""

from __future__ import annotations

import os.path
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gapbridge.bridge.cell.verification_mark import mark_path, read_mark, remove_mark
from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.core.errors import RunError

LONGEST_WAIT = 0.2  # s for a file system; a network mount may hang, and no disarm waits for it


class VerificationWatch:
    """Reports when the mark of a cell comes, changes or goes; None: there is no cell to watch.

    ``longest_wait``: s of real time for a call of the file system; None: until it has ended.
    """

    def __init__(self, cell: Path | None, longest_wait: float | None = LONGEST_WAIT) -> None:
        self._cell, self._longest_wait = cell, longest_wait
        self._reason = ""  # of the mark that was reported last; empty: none
        self._call: _Call | None = None  # that has not ended in time
        self.problem = ""  # why an acknowledged mark is still there

    @property
    def blocked(self) -> str:
        """Return why nobody knows whether there is a mark; empty: it was looked for just now."""
        if self._call is None or self._cell is None:
            return ""
        return f"{mark_path(self._cell).parent}: the file system does not answer"

    def look(self) -> Event | None:
        """Return an event if the mark has come, changed or gone since the last call."""
        found = self._within(_found)
        if found is None:
            return None
        reason, is_there = found
        if reason == self._reason or (not reason and not is_there):
            return None  # without the cell its folder is away: that passes no verification
        before, self._reason = self._reason, reason
        detail = reason or f"acknowledged or verified again: {before}"
        return {"kind": EventKind.VERIFICATION, "holds": not reason, "detail": detail}

    def acknowledge(self) -> None:
        """Remove the mark that was reported last; a newer one stays."""
        reason, self.problem = self._reason, ""
        if not reason:
            return
        problem = self._within(lambda cell: _removed(cell, reason))
        self.problem = self.blocked if problem is None else problem

    def _within(self, what: Callable[[Path], Any]) -> Any:
        """Return what a call returns; None if it, or one before it, does not end in time."""
        if self._cell is None or (self._call is not None and self._call.is_alive()):
            return None
        self._call = call = _Call(what, self._cell)
        try:
            call.start()
        except RuntimeError:  # no thread can be started: nobody knows either
            return None
        call.join(self._longest_wait)
        if call.is_alive():
            return None
        self._call = None
        return call.found


class _Call(threading.Thread):
    """A call that nobody has to wait for, not even the end of the process."""

    def __init__(self, what: Callable[[Path], Any], cell: Path) -> None:
        super().__init__(name="mark", daemon=True)
        self._what, self._cell = what, cell
        self.found: Any = None

    def run(self) -> None:
        """See threading.Thread."""
        self.found = self._what(self._cell)


def _found(cell: Path) -> tuple[str, bool]:
    return read_mark(cell), os.path.exists(cell)


def _removed(cell: Path, reason: str) -> str:
    """Remove a mark unless it is a newer one; returns why it could not be."""
    if read_mark(cell) != reason:
        return ""
    try:
        remove_mark(cell)
    except RunError as error:
        return str(error)
    return ""
