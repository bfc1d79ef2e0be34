"""Reloading a changed cell file while the daemon runs: applied completely, or not at all.

The offset is ramped out, the loop ends, and one with the new cell starts: observing, unless the arm
was compensating, nothing but the reload ended that, and the new cell has ``setpoints.arm``.
"""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from gapbridge.bridge.cell.cell import cell_errors
from gapbridge.bridge.cell.run_settings import Configuration, read_configuration
from gapbridge.bridge.daemon.service_manager import ServiceManager
from gapbridge.bridge.ipc.events import Event, EventKind, EventLog
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import Phase
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.core.errors import GapbridgeError
from gapbridge.drivers.controller_address import address_of

KEPT_UNTIL_RESTART = ("recording", "web", "metrics")
"""Sections of side processes, which keep running; a change takes effect at the next start."""
OWN_CAUSES = (Cause.ARM, Cause.WRITING, Cause.DISARM, Cause.RAMPED_OUT)
"""Transitions of a loop that arms, compensates and ramps out for a reload."""
MOTION = tuple(state.name for state in (State.ARMED, State.COMPENSATING, State.HOLDING))
"""States that another transition ends for good; a link may connect after arming was requested."""


class Swap(NamedTuple):
    """What the next loop starts with."""

    configuration: Configuration | None  # None: unchanged
    rearms: bool  # it was compensating, and the new cell arms by itself
    in_order: bool  # the last loop was stopped for the reload


class Reload:
    """A reload from its request to the new loop.

    ``in_thread``: files are read in a thread, because a network mount may hang; otherwise at once.
    """

    def __init__(
        self, manager: ServiceManager, event_log: EventLog, in_thread: bool = True
    ) -> None:
        self._manager, self._event_log = manager, event_log
        self._in_thread = in_thread
        self._requested = threading.Event()
        self._reading: _Reading | None = None
        self._next: Configuration | None = None
        self._compensated = False  # when a reload was requested
        self._rearm = False  # it was compensating, and the new cell arms by itself
        self._ended = False  # since it was armed last, something else ended the motion
        self.wants_end = False  # the loop is to be stopped: nothing is being written

    def ask(self) -> None:
        """Request a reload; from any thread."""
        self._requested.set()

    def step(self, state: State, phase: Phase, running: Configuration) -> bool:
        """Continue a requested reload; returns whether the loop must ramp out now."""
        if self._requested.is_set() and self._reading is None:
            self._begin(running)
        if self._reading is not None and not self._reading.is_alive():
            reading, self._reading = self._reading, None
            self._take(state, running, reading)
        if self._next is None or self.wants_end or phase == Phase.ARMING:
            return False
        if state in (State.ARMED, State.COMPENSATING):
            return True
        self._ended |= state in (State.FAULT, State.DISCONNECTED)
        self.wants_end = state != State.HOLDING
        return False

    def on_event(self, event: Event) -> None:
        """Note a person, a fault or a lost link that ends the motion: it stays ended."""
        kind = event["kind"]
        if kind == EventKind.REQUEST:
            self._ended = event["command"] == "disarm"
        elif kind == EventKind.TRANSITION:
            self._ended |= event["from"] in MOTION and event["cause"] not in OWN_CAUSES
        elif kind in (EventKind.FAULT, EventKind.FAILURE, EventKind.SLIP, EventKind.VERIFICATION):
            self._ended = True

    def swap(self) -> Swap:
        """Return what the next loop starts with, also if the last one died meanwhile.

        The service manager is notified at the new loop's first cycle.
        """
        following, ended = self._next, self.wants_end
        rearm = self._rearm and ended and not self._ended
        self._next, self.wants_end, self._rearm, self._compensated = None, False, False, False
        if following is None:
            return Swap(None, rearms=False, in_order=False)
        return Swap(following, rearms=rearm, in_order=ended)

    def _begin(self, running: Configuration) -> None:
        """Begin to read the files."""
        self._requested.clear()
        reading = _Reading(running)
        if not self._in_thread:
            reading.run()
        else:
            try:
                reading.start()
            except RuntimeError:  # no thread can be started: tried again
                self._requested.set()
                return
        self._manager.reloading()
        self._reading = reading

    def _take(self, state: State, running: Configuration, reading: _Reading) -> None:
        """Take what was read, or report why not."""
        new = reading.found
        if new is None:
            self._manager.ready()
            detail = f"the cell file was not taken, the old one stays: {reading.problem}"
            self._report(False, running if self._next is None else self._next, detail)
            return
        self._next = new
        self._compensated |= state == State.COMPENSATING  # a second one comes in the ramp
        self._rearm = self._compensated and new.settings.setpoints.arm
        later = f"; {', '.join(reading.later)}: at the daemon's next start" if reading.later else ""
        detail = f"the cell file was read again and is being taken{later}"
        self._report(True, self._next, detail)

    def _report(self, fine: bool, active: Configuration, detail: str) -> None:
        self._event_log.add(
            {"kind": EventKind.CONFIGURATION, "ok": fine, "hash": active.hash, "detail": detail}
        )


class _Reading(threading.Thread):
    """Reads a cell and its files; nobody waits for it, not even the end of the process."""

    def __init__(self, running: Configuration) -> None:
        super().__init__(name="reload", daemon=True)
        self._running = running
        self.found: Configuration | None = None  # with what must not change in a run
        self.later: list[str] = []  # sections that have changed and are not taken in this run
        self.problem = "it could not be read"  # without which nothing was found

    def run(self) -> None:
        """See threading.Thread."""
        before = self._running.settings
        cell = before.cell
        try:
            new = read_configuration(cell)
            self.later = [
                name for name in KEPT_UNTIL_RESTART
                if getattr(new.settings, name) != getattr(before, name)
            ]  # fmt: skip
            self.found = _compatible(new, self._running)
        except GapbridgeError as error:
            self.problem = "; ".join(_messages(cell, error))


def _compatible(new: Configuration, running: Configuration) -> Configuration:
    """Return the new configuration with what must not change in a run. Raises GapbridgeError."""
    settings, before = new.settings, running.settings
    if new.n != running.n:
        raise GapbridgeError(
            f"{settings.cell}: robot: found {new.n} joints, expected {running.n} as before: "
            "stop and restart the daemon"
        )
    if address_of(settings.link) != address_of(before.link):
        raise GapbridgeError(
            f"{settings.cell}: link: found {address_of(settings.link)}, expected "
            f"{address_of(before.link)} as before: stop and restart the daemon"
        )
    kept = ("model_source", "hang_timeout", "backoff", *KEPT_UNTIL_RESTART)
    fixed = {name: getattr(before, name) for name in kept}
    return replace(new, settings=settings.model_copy(update=fixed))


def _messages(cell: Path, error: GapbridgeError) -> list[str]:
    """Return all errors of a cell file."""
    try:
        return cell_errors(cell) or [str(error)]
    except GapbridgeError:
        return [str(error)]
