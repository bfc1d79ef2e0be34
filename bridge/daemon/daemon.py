"""The daemon: the parent that survives its loop.

It starts the loop in a process of its own, watches the heartbeat, ends what hangs, starts anew what
died (observing, never writing), looks after the processes that record and show, and says at the end
how it went.
"""

from __future__ import annotations

import queue
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

from bridge.cell.daemon_settings import DaemonSettings
from bridge.cell.run_settings import configuration_for, settings_of
from bridge.daemon.control import Control
from bridge.daemon.opening import open_all
from bridge.daemon.processes import LoopProcess
from bridge.daemon.reload import Reload
from bridge.daemon.service_manager import ServiceManager
from bridge.daemon.sides import Sides
from bridge.daemon.status import DaemonStatus
from bridge.daemon.summary import RunSummary, Tally
from bridge.ipc.control_socket import ControlSocket
from bridge.ipc.events import Event, EventBook
from bridge.ipc.shared_memory import Command, Page, Phase
from bridge.loop.loop import LONGEST_STOP, Exit
from bridge.loop.supervisor import State
from core.errors import InputError, LinkError

__all__ = ["Daemon", "Say", "settings_of"]

TICK = 0.02  # s between two looks at the loop
HEALTHY = 10.0  # s after which a restart counts as the first again
STOP_MARGIN = 0.4  # s on top of the loop's own time: then it is ended by force
STATUS_EVERY = 0.5  # s

Say = Callable[[str], None]


class Daemon:
    """One run. ``stop``, ``reload``, ``arm`` and ``disarm`` may be called from other threads."""

    def __init__(
        self,
        settings: DaemonSettings,
        may_write: bool,
        say: Say = lambda _: None,
        log: Callable[[Event], None] | None = None,
    ) -> None:
        self.configuration = configuration_for(settings)
        self.may_write, self._say = may_write, say
        n = self.configuration.n
        self.page = Page(n)  # one for the whole run, whatever becomes of the loops
        self._reader = self.page.reader()
        self.output: IO[bytes] | int = subprocess.DEVNULL  # of all processes of the run
        self.sides = Sides()
        self.tally = Tally(n, settings.link.rate)
        listeners = [self._hear, self.sides.tell]
        self.book = EventBook(*listeners, *([log] if log else []))
        self._posted: queue.SimpleQueue[Event] = queue.SimpleQueue()  # by other threads
        self.manager = ServiceManager()
        self.session = ""
        self._status = DaemonStatus(self)
        self._status_at = 0.0
        self._reload = Reload(self)
        self.control = Control(self)
        self.socket: ControlSocket | None = None
        self.loop: LoopProcess | None = None
        self._failure: Event = {}
        self._faults: list[str] = []
        self._lost_rows = 0
        self._refused = False  # writing was asked for and could not begin
        self._seen = False  # a state has been read, by this or a former loop
        self.restarts = 0
        self._loops = 0  # processes of the loop so far, those of a reload among them
        self._wait = settings.backoff[0]
        self._last_state = State.DISCONNECTED
        self._stopping = threading.Event()

    # -- for others -------------------------------------------------------------------------------

    @property
    def settings(self) -> DaemonSettings:
        """Return what runs now; a reload changes it."""
        return self.configuration.settings

    @property
    def state(self) -> State:
        """Return what the loop is doing."""
        return self._last_state

    @property
    def phase(self) -> Phase:
        """Return what the loop's process is at."""
        return self.page.phase

    @property
    def latched(self) -> str:
        """Return the fault that waits for being acknowledged; empty: none."""
        return self._status.latched

    @property
    def sequence(self) -> int:
        """Return the number of the last event."""
        return self.book.sequence

    @property
    def loop_pid(self) -> int | None:
        """Return the process id of the loop, None between two of them."""
        loop = self.loop
        return None if loop is None else loop.pid

    @property
    def recording(self) -> Path | None:
        """Return the run's recording as a whole: its files' name without their numbers."""
        folder = self.settings.recording.folder
        return None if folder is None or not self.session else folder / self.session

    @property
    def lost_rows(self) -> int:
        """Return how many cycles the recorder says that no file holds."""
        return self._lost_rows

    def events_since(self, sequence: int) -> list[Event]:
        """Return the events after a number."""
        return self.book.since(sequence)

    def status(self) -> dict[str, Any]:
        """Return the status document."""
        return self._status.document()

    def note(self, event: Event) -> None:
        """Have an event told by the daemon's own thread."""
        self._posted.put(event)

    def stop(self) -> None:
        """Ramp out and end."""
        self._stopping.set()

    def reload(self) -> None:
        """Read the cell file again; what is wrong is told, and the old one stays."""
        self._reload.ask()

    def arm(self, by: str = "") -> None:
        """Ask the loop to write setpoints."""
        if self.loop is not None and self.may_write:
            self.told_to_arm(by)
            self.page.ask(Command.ARM)

    def told_to_arm(self, by: str) -> None:
        """Take note of who or what has asked for arming."""
        self._status.armed_by = by

    def disarm(self, by: str = "") -> None:
        """Ask the loop to ramp out and observe; in a fault, acknowledge it."""
        if self.loop is not None:
            self.page.ask(Command.DISARM)

    # -- the run ----------------------------------------------------------------------------------

    def run(self, arm: bool = False, duration: float | None = None, by: str = "") -> RunSummary:
        """Run until stopped; ``by`` says who or what has asked for arming. See run_cell."""
        with ExitStack() as stack:
            arm = open_all(self, stack, arm, by)
            while not self._stopping.is_set():
                self._run_loop(arm, duration)
                arm = self._reload.swap()  # else only a person starts the writing again
                if not self._stopping.is_set() and not self._reload.swapped:
                    self._pause()
                    self.restarts += 1
            self._take()
            return self._summary()

    def _pause(self) -> None:
        """Wait before the next process of the loop, and go on looking after the rest."""
        until = time.monotonic() + self._wait
        self._wait = min(2.0 * self._wait, self.settings.backoff[1])
        while time.monotonic() < until and not self._stopping.wait(TICK):
            self._tick()

    def _tick(self) -> None:
        """Look after everything but the loop."""
        self._take()
        for event in self.sides.check():
            self.book.add(event)
        while not self._posted.empty():
            self.book.add(self._posted.get())
        if time.monotonic() >= self._status_at:
            self._status_at = time.monotonic() + STATUS_EVERY
            self.sides.tell({"kind": "status", **self.status()})
        loop = self.loop
        if loop is None or not loop.hangs:
            self.manager.kick()

    def _run_loop(self, arm: bool, duration: float | None) -> None:
        """Run one process of the loop to its end."""
        self._last_state = State.DISCONNECTED
        self._failure = {}
        loop = self.loop = LoopProcess(
            self.settings, self.page, arm, self.may_write, self.output, self._loops,
            self._status.latched,
        )  # fmt: skip
        self._loops += 1
        stop_by = first_cycle = None
        try:
            while loop.exit_code is None:
                time.sleep(TICK)
                self._tick()
                if self.page.seen and first_cycle is None:
                    first_cycle, self._seen = time.monotonic(), True
                    self.manager.ready()
                over = first_cycle is not None and (
                    duration is not None and time.monotonic() - first_cycle >= duration
                )
                if over or (self.page.ended and duration is None):
                    self._stopping.set()
                self._reload.step(self.state, self.phase)
                if (self._stopping.is_set() or self._reload.wants_end) and stop_by is None:
                    stop_by = time.monotonic() + LONGEST_STOP + STOP_MARGIN
                    if self._stopping.is_set():
                        self.manager.stopping()
                    loop.ask_to_stop()
                if loop.hangs or (stop_by is not None and time.monotonic() > stop_by):
                    words = f"the loop stood still for {self.page.silence:.2f} s and was ended"
                    loop.kill()  # told when it is over: nothing is written after that
                    self._fault("hang", words)
            self._take()
            self._after(loop)
            if first_cycle is not None and time.monotonic() - first_cycle > HEALTHY:
                self._wait = self.settings.backoff[0]
        finally:
            self.loop = None
            loop.close()

    def _take(self) -> None:
        """Take cycles and events over from the loop."""
        # in this order: who has heard of a change finds the state changed, and its rows counted
        events = [] if self.loop is None else self.loop.events()
        if self.loop is not None:
            self._last_state = State(self.page.state)
        rows = self._reader.drain()
        self.tally.add(rows)
        self._status.take(rows)
        for event in events:
            self.book.add(event)

    def _hear(self, event: Event) -> None:
        """Act on an event, and tell it to the person at the terminal."""
        kind, detail = event["kind"], str(event.get("detail", ""))
        self._status.hear(event)
        if kind == "failure":
            self._failure = event
        if kind == "refused":
            self._refused = True
        if kind == "recorder":
            self._lost_rows += int(event.get("lost", 0))
        if kind == "transition":
            tail = f": {detail}" if detail else ""
            text = f"{event['from'].lower()} -> {event['to'].lower()} ({event['cause']}){tail}"
            self._say(text)
            self._refused |= event["cause"] == "start refused"
            if detail:
                self._faults.append(text)
        elif detail and kind not in ("granted", "summary"):
            self._say(detail)

    def _after(self, loop: LoopProcess) -> None:
        """Judge how the loop's process ended; raises where it is no use to start it again."""
        code = loop.exit_code
        if code == Exit.DONE:
            if not self._reload.wants_end:
                self._stopping.set()
            return
        self._last_state = State.DISCONNECTED
        self._status.lost_loop()
        words = str(self._failure.get("detail", "")) or f"the loop's process {loop.describe_end()}"
        if self._stopping.is_set() and not self._failure:
            return
        if code == Exit.INPUT and not self._seen:
            raise InputError(words)  # later, it is a file that somebody is at: tried again
        if not self._seen:
            raise LinkError(words)
        self._fault("loop", words)

    def _fault(self, cause: str, words: str) -> None:
        self._faults.append(words)
        self.book.add({"kind": "fault", "cause": cause, "detail": words})

    def _summary(self) -> RunSummary:
        state = self._last_state
        wrong = self._refused and not self.tally.written
        wrong |= state in (State.FAULT, State.DISCONNECTED)
        summary = RunSummary(
            **self.tally.figures(),
            restarts=self.restarts,
            lost_rows=self.lost_rows,
            faults=tuple(self._faults),
            state=state.name.lower(),
            exit_code=1 if wrong else 0,
            recording=self.recording,
        )
        self.book.add({"kind": "summary", "summary": summary.to_json()})
        return summary
