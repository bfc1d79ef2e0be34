"""One run of the daemon in a thread of its own, its cycles at hand."""

from __future__ import annotations

import threading

import numpy as np

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.ipc.shared_memory import PageReader
from gapbridge.core.arrays import Array
from gapbridge.core.errors import GapbridgeError, LinkError

KEPT = 20.0  # s of cycles that are kept
STEP = 1e-5  # rad: a joint that has come this far has moved, in that direction
FOREVER = 1e9  # s


class WatchedRun:
    """One run of the daemon in a thread of its own."""

    def __init__(self, settings: DaemonSettings, write: bool) -> None:
        self.daemon = Daemon(settings, may_write=write, say=self._say)
        self.slices = self.daemon.page.slices
        self.rows = np.empty((0, self.daemon.page.width))
        self.approach = np.zeros(self.daemon.page.n)
        self._turned_at: Array | None = None
        self._reader: PageReader | None = self.daemon.page.reader()
        self._messages: list[str] = []
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._main, args=(write,), daemon=True)
        self._thread.start()

    def _say(self, text: str) -> None:
        self._messages.append(text)

    def _main(self, write: bool) -> None:
        try:
            self.daemon.run(arm=write, duration=FOREVER, by="--arm")
        except BaseException as error:
            self._error = error

    def message(self) -> str:
        """Return what the daemon said last."""
        return self._messages[-1] if self._messages else ""

    def messages(self, since: int = 0) -> list[str]:
        """Return what the daemon said, from the message of that number on."""
        return self._messages[since:]

    def check(self) -> None:
        """Raise what ended the run."""
        if self._thread.is_alive():
            return
        if isinstance(self._error, GapbridgeError):
            raise self._error
        raise LinkError(
            f"the link to the arm ended: {self._error or self.message() or 'no reason'}"
        )

    def take(self) -> None:
        """Take the cycles over that came since the last call."""
        if self._reader is None:
            return
        try:
            new = self._reader.drain()
        except (IndexError, ValueError):  # the page was closed meanwhile
            return
        if not len(new):
            return
        at = self.slices["timestamp"].start
        self._follow_motion(new[:, self.slices["actual_q"]])
        rows = np.vstack([self.rows, new])
        self.rows = rows[rows[:, at] >= rows[-1, at] - KEPT]

    def _follow_motion(self, q: Array) -> None:
        before = q[0].copy() if self._turned_at is None else self._turned_at
        for row in q:
            way = row - before
            moved = np.abs(way) > STEP
            self.approach[moved] = np.sign(way[moved])
            before[moved] = row[moved]
        self._turned_at = before

    def end(self) -> None:
        """End the run."""
        self._reader = None
        self.daemon.stop()
        self._thread.join(20.0)
