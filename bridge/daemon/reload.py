"""A changed cell file while the daemon runs: taken whole, or not at all.

The motion is ramped out, the loop ends, and one with the new cell begins: observing, unless the arm
was compensating before and the new cell says itself that it arms.
"""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gapbridge.bridge.cell.cell import complaints
from gapbridge.bridge.cell.run_settings import Configuration, read_configuration
from gapbridge.bridge.ipc.shared_memory import Phase
from gapbridge.bridge.loop.supervisor import State
from gapbridge.core.errors import GapbridgeError
from gapbridge.drivers.controller_address import address_of

if TYPE_CHECKING:
    from gapbridge.bridge.daemon.daemon import Daemon

KEPT_UNTIL_RESTART = ("recording", "web", "metrics")
"""Sections whose processes go on as they are; a changed one takes effect at the next start."""


class Reload:
    """One request to read the cell again, from asking to the new loop."""

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon
        self._asked = threading.Event()
        self._next: Configuration | None = None
        self._rearm = False  # it was compensating, and the new cell arms by itself
        self.wants_end = False  # the loop is to be stopped: nothing is being written
        self.swapped = False  # the last loop ended for a new cell

    def ask(self) -> None:
        """Ask for the cell to be read again; from any thread."""
        self._asked.set()

    def step(self, state: State, phase: Phase) -> None:
        """Go on with a reload that was asked for."""
        if self._asked.is_set():
            self._asked.clear()
            self._read(state)
        if self._next is None or self.wants_end or phase == Phase.ARMING:
            return
        if state in (State.ARMED, State.COMPENSATING):
            self._daemon.ramp_out()
        elif state != State.HOLDING:
            self.wants_end = True

    def swap(self) -> bool:
        """Put the new cell in place after a loop has ended; returns whether the next may arm."""
        following, rearm = self._next, self._rearm and self.wants_end
        self.swapped = self.wants_end and following is not None
        self._next, self._rearm, self.wants_end = None, False, False
        if following is None:
            return False
        self._daemon.configuration = following  # a loop that died instead begins with it too
        return rearm  # the service manager hears of it with the new loop's first cycle

    def _read(self, state: State) -> None:
        daemon = self._daemon
        daemon.manager.reloading()
        try:
            found = read_configuration(daemon.settings.cell)
            self._next = self._fitting(found)
        except GapbridgeError as error:
            daemon.manager.ready()
            words = "; ".join(_all_of(daemon.settings.cell, error))
            self._tell(False, f"the cell file was not taken, the old one stays: {words}")
            return
        self._rearm = state == State.COMPENSATING and found.settings.setpoints.arm
        changed = [
            name for name in KEPT_UNTIL_RESTART
            if getattr(found.settings, name) != getattr(daemon.settings, name)
        ]  # fmt: skip
        later = f"; {', '.join(changed)}: at the daemon's next start" if changed else ""
        self._tell(True, f"the cell file was read again and is being taken{later}")

    def _fitting(self, found: Configuration) -> Configuration:
        """Return a configuration that this run can go on with. Raises GapbridgeError."""
        daemon, settings = self._daemon, found.settings
        if found.n != daemon.configuration.n:
            raise GapbridgeError(
                f"{settings.cell}: robot: found {found.n} joints, expected "
                f"{daemon.configuration.n} as before: stop the daemon and start it anew"
            )
        if address_of(settings.link) != address_of(daemon.settings.link):
            raise GapbridgeError(
                f"{settings.cell}: link: found {address_of(settings.link)}, expected "
                f"{address_of(daemon.settings.link)} as before: stop the daemon and start it anew"
            )
        before = daemon.settings
        kept = {name: getattr(before, name) for name in ("model_source", "hang_timeout", "backoff")}
        return replace(found, settings=settings.model_copy(update=kept))

    def _tell(self, fine: bool, words: str) -> None:
        hashed = self._next.hash if self._next is not None else self._daemon.configuration.hash
        self._daemon.book.add(
            {"kind": "configuration", "ok": fine, "hash": hashed, "detail": words}
        )


def _all_of(cell: Path, error: GapbridgeError) -> list[str]:
    """Return everything that is wrong with a cell file, where it is more than one thing."""
    try:
        return complaints(cell) or [str(error)]
    except GapbridgeError:
        return [str(error)]
