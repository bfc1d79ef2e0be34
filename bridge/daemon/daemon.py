"""The daemon: the parent process, which survives its loop.

It starts the loop as a process, monitors its heartbeat, kills it if it hangs, restarts it if it
died (observing, never writing), manages the side processes (recorder, status page, metrics), and
returns a summary of the run.
"""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.run_settings import Configuration, configuration_for
from gapbridge.bridge.daemon.control import Control
from gapbridge.bridge.daemon.fitted_watch import FittedWatch
from gapbridge.bridge.daemon.owner_lock import OwnerLock
from gapbridge.bridge.daemon.processes import LoopProcess, ramp_out
from gapbridge.bridge.daemon.reload import Reload
from gapbridge.bridge.daemon.requests import Requests
from gapbridge.bridge.daemon.service_manager import ServiceManager
from gapbridge.bridge.daemon.side_processes import SideProcesses
from gapbridge.bridge.daemon.status import DaemonStatus
from gapbridge.bridge.daemon.status_document import SCHEMA
from gapbridge.bridge.daemon.summary import Faults, RunSummary, Tally, places
from gapbridge.bridge.daemon.zero_watch import ZeroWatch
from gapbridge.bridge.ipc.command_memory import Command, CommandMemory
from gapbridge.bridge.ipc.events import Event, EventKind, EventLog
from gapbridge.bridge.ipc.loop_counters import DROPPED
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import Phase, RunMemory
from gapbridge.bridge.loop.loop import STOP_TIMEOUT, Exit
from gapbridge.bridge.loop.setpoint_stream import longest_ramp_out
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.bridge.recording.folder import RunFiles
from gapbridge.core.errors import InputError, LinkError
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.controller_address import address_of

TICK = 0.02  # s between two checks of the loop
HEALTHY = 10.0  # s of running after which the backoff is reset
STOP_MARGIN = 0.4  # s after the loop's own deadline until it is killed
STATUS_EVERY = 0.5  # s
PROGRAM = f"the daemon's own program (pid {os.getpid()})"

NOT_SHOWN = (EventKind.FAILURE, EventKind.GRANTED, EventKind.SUMMARY, EventKind.REQUEST)
"""Kinds of events that the terminal does not show: after a failure a fault follows."""

Say = Callable[[str], None]


class Daemon:
    """One run. ``stop``, ``reload``, ``arm`` and ``disarm`` may be called from other threads."""

    loop_process: type[LoopProcess] = LoopProcess  # simulations replace it

    def __init__(
        self,
        configuration: DaemonSettings | Configuration,
        may_write: bool,
        clock: Clock,
        say: Say = lambda _: None,
        log: Callable[[Event], None] | None = None,
    ) -> None:
        self._clock = clock
        if not isinstance(configuration, Configuration):
            configuration = configuration_for(configuration)
        self.configuration = configuration  # read once; loops get the same bytes
        settings, n = configuration.settings, configuration.n
        self.may_write, self._say = may_write, say
        self.memory = RunMemory(n, clock)  # of the present process of the loop
        self._commands = CommandMemory()  # one for the whole run; only the daemon can write
        self._last_taken = 0
        self._reader = self.memory.reader()
        self._files = RunFiles(settings.recording.folder, clock)
        self.side_processes = SideProcesses(clock)
        self.tally = Tally(n, settings.link.rate)
        listeners = [self._on_event, self.side_processes.emit]
        self.event_log = EventLog(*listeners, *([log] if log else []), clock=clock)
        self._posted: queue.SimpleQueue[Event] = queue.SimpleQueue()  # from other threads
        self.manager = ServiceManager(clock)
        self.session = ""
        self._status = DaemonStatus(self.memory.slices, clock)
        self._fitted = FittedWatch(configuration.fitted, self.memory.slices)
        self._zeros = ZeroWatch(
            configuration, self.memory.slices, self._status, self.event_log.add,
            self._commands, clock,
        )  # fmt: skip
        self._requests = Requests(
            self._commands, self.event_log.add, lambda: self._status.unacknowledged,
            self._zeros.obstacle_to,
        )  # fmt: skip
        self._status_at = 0.0
        self._reload = Reload(self.manager, self.event_log)
        self.control = Control(self, clock)
        self.loop: LoopProcess | None = None
        self._failure: Event = {}
        self._faults = Faults()
        self.lost_rows = 0  # cycles that the recorder has lost
        self._refused = False  # arming was requested and refused
        self._has_state = False  # a state has been read in this run
        self._ends_at = float("inf")  # s, monotonic: end of a run with a duration
        self.restarts = 0
        self._loops = 0  # processes of the loop so far, including those after a reload
        self._wait = settings.backoff[0]
        self._last_state = State.DISCONNECTED
        self._stopping = threading.Event()
        self._lock: OwnerLock | None = None

    # -- status and requests ----------------------------------------------------------------------

    @property
    def settings(self) -> DaemonSettings:
        """Return the present settings; a reload changes them."""
        return self.configuration.settings

    @property
    def state(self) -> State:
        """Return the state of the loop."""
        return self._last_state

    @property
    def phase(self) -> Phase:
        """Return the phase of the loop's process."""
        return self.memory.phase

    @property
    def latched(self) -> str:
        """Return the latched fault, not acknowledged yet; empty: none."""
        return self._status.latched

    @property
    def armed_by(self) -> str:
        """Return who armed; empty: it is not armed, by the events so far."""
        return self._status.armed_by

    @property
    def mark_problem(self) -> str:
        """Return why an acknowledged mark of a failed verification is still there; empty: no."""
        return self._zeros.verification.problem

    @property
    def sequence(self) -> int:
        """Return the number of the last event."""
        return self.event_log.sequence

    @property
    def loop_pid(self) -> int | None:
        """Return the process id of the loop, None between two of them."""
        loop = self.loop
        return None if loop is None else loop.pid

    @property
    def recording(self) -> Path | None:
        """Return the path of the run's recording: its files' names without their numbers."""
        folder = self.settings.recording.folder
        return None if folder is None or not self.session else folder / self.session

    def events_since(self, sequence: int) -> list[Event]:
        """Return the events after a number."""
        return self.event_log.since(sequence)

    def status(self) -> dict[str, Any]:
        """Return the status document; may be called from any thread."""
        status, tally, recording = self._status, self.tally, self.recording
        counted = self.memory.counts()
        dropped = {reason.value: counted[count.label] for reason, count in DROPPED.items()}
        loop = {"pid": self.loop_pid, "restarts": self.restarts, "phase": self.phase.name.lower()}
        return {
            "schema": SCHEMA,
            "time": self._clock.time(),
            "pid": os.getpid(),
            "started": status.started,
            "session": self.session,
            "cell": str(self.settings.cell),
            "configuration_hash": self.configuration.hash,
            "configured": status.configured,
            "state": status.named(self.state),
            **status.history(),
            "may_write": self.may_write,
            "armed_by": self.armed_by,
            "latched": status.latched,
            "correction": status.correction,
            "zeros": self._zeros.slips.detail,
            "loop": loop,
            "link": {
                "driver": self.settings.link.driver,
                **status.link(),
                **tally.counts.totals(),
                "dropped": dropped,
            },
            "counts": counted,
            "events": dict(self.event_log.counts),
            "sides": self.side_processes.status(),
            "recording": None if recording is None else str(recording),
            "lost_rows": self.lost_rows,
        }

    def _take_configuration(self, new: Configuration) -> None:
        """Take what the next loop runs with."""
        self.configuration = new
        self.side_processes.configure(new)
        self._fitted = FittedWatch(new.fitted, self.memory.slices)
        self._zeros.configure(new)

    def note(self, event: Event) -> None:
        """Queue an event, which the daemon's thread emits."""
        self._posted.put(event)

    def stop(self) -> None:
        """Ramp out and end."""
        self._stopping.set()

    def reload(self) -> None:
        """Read the cell file again; if it has errors, they are reported and the old one stays."""
        self._reload.ask()

    @property
    def last_taken(self) -> int:
        """Return the number of the newest request that a loop has received."""
        return self._last_taken

    def arm(self, by: str = PROGRAM) -> int:
        """Request writing; returns the request's number, 0 if it cannot be made."""
        if self.loop is None or not self.may_write:
            return 0
        return self._requests.make(Command.ARM, by)

    def disarm(self, by: str = PROGRAM) -> int:
        """Request ramping out and observing, from this loop or the next; acknowledge a fault.

        What occurs after this call is not acknowledged. Returns the request's number: the loop has
        received it once ``last_taken`` reaches it.
        """
        faulty = self.latched or self.state == State.FAULT  # its event may have been lost
        return self._requests.make(Command.DISARM if faulty else Command.RAMP_OUT, by)

    # -- the run ----------------------------------------------------------------------------------

    def run(self, arm: bool = False, duration: float | None = None, by: str = "") -> RunSummary:
        """Run until stopped; ``by``: who or what requested arming. See run_cell.

        ``duration``, s, counts from the first cycle of the run, also through lost links.
        """
        with ExitStack() as stack:
            arm, since = self._open(stack, arm, by), 0
            while not self._stopping.is_set():
                self._run_loop((by or PROGRAM) if arm else "", since, duration)
                since = self._requests.forward_all()  # what has come by now ends a reload's arming
                swap = self._reload.swap()
                self._take_configuration(swap.configuration or self.configuration)
                arm = swap.rearms  # otherwise only a person can arm again
                by = "the cell file" if arm else ""
                if not self._stopping.is_set() and not swap.in_order:
                    self._pause()
                    self.restarts += 1
            self._read_loop()
            summary = self._summary()
            self._note_end()
        return replace(summary, lost_rows=self.lost_rows)  # the recorder has finished since

    def _open(self, stack: ExitStack, arm: bool, by: str) -> bool:
        """Open locks, sockets and processes; ``stack`` closes them.

        Returns whether the first loop may arm by itself. Raises InputError if another daemon owns
        the controller, or a folder cannot be used.
        """
        settings = self.settings
        stack.callback(self._commands.close)
        stack.callback(self.memory.close)
        lock = stack.enter_context(OwnerLock(address_of(settings.link), settings.cell))
        self.session = stack.enter_context(self._files).session
        stack.callback(self.side_processes.close, self.event_log.add)
        self.side_processes.start(self.configuration, self.session, self.memory, self._files.log)
        stack.callback(lambda: self.event_log.add({"kind": EventKind.ENDED}))
        self._zeros.open()
        stack.callback(self._zeros.close)
        stack.enter_context(self.control.socket(settings.cell))
        for where in places(settings):
            self.event_log.add({"kind": EventKind.NOTE, "detail": where})
        return self._take_over(lock, arm, by)

    def _take_over(self, lock: OwnerLock, arm: bool, by: str) -> bool:
        """Go on from how the last run ended; returns whether the first loop may arm by itself."""
        self._lock = lock
        self._status.restore(str(lock.before.get("latched", "")))
        # after a crash --arm from a terminal may arm, a restarted service may not
        if arm and lock.disorder and (by != "--arm" or self.manager.present):
            detail = f"{lock.disorder}: not arming by itself; gapbridge arm"
            self.event_log.add({"kind": EventKind.REFUSED, "what": "arm", "detail": detail})
            return False
        return arm

    def _note_latched(self) -> None:
        """Have the lock's note say what is latched, for a daemon after this one has died."""
        if self._lock is not None:
            self._lock.note_latched(self._status.lasting)

    def _note_end(self) -> None:
        """Have the lock say whether the next daemon may arm by itself."""
        cut_off = self.memory.ended and self.state == State.DISCONNECTED  # it would begin again
        if self._lock is not None:
            self._lock.note_end(self.state != State.FAULT and not (self._status.lasting or cut_off))

    def _pause(self) -> None:
        """Wait before the next process of the loop; the side processes are served meanwhile."""
        until = self._clock.monotonic() + self._wait
        self._wait = min(2.0 * self._wait, self.settings.backoff[1])
        while self._clock.monotonic() < until and not self._clock.wait(self._stopping, TICK):
            self._tick()

    def _tick(self) -> None:
        """Serve requests, side processes and events."""
        if self._clock.monotonic() >= self._ends_at:
            self._stopping.set()
        self._read_loop()
        self._requests.forward()
        if self.memory.promote():
            self.side_processes.show(self.memory)
        for event in self.side_processes.check():
            self.event_log.add(event)
        while not self._posted.empty():
            self.event_log.add(self._posted.get())
        if self._clock.monotonic() >= self._status_at:
            self._status_at = self._clock.monotonic() + STATUS_EVERY
            self._zeros.check()
            self._zeros.keep()
            self.side_processes.emit({"kind": EventKind.STATUS, **self.status()})
        loop = self.loop
        if loop is None or not loop.hangs:
            self.manager.kick()

    def _run_loop(self, armed_by: str, since: int, duration: float | None) -> None:
        """Run one process of the loop to its end; see _start_loop."""
        self._last_state = State.DISCONNECTED
        self._failure = {}
        try:
            loop = self.loop = self._start_loop(armed_by, since)
        except OSError as error:  # memory, processes or descriptors are short
            self._on_loop_end(None, f"the loop's process cannot be started: {error.strerror}")
            return
        stop_by = first_cycle = None
        try:
            while loop.exit_code is None:
                self._clock.sleep(TICK)
                self._tick()
                if self.memory.has_state and first_cycle is None:
                    first_cycle = self._clock.monotonic()
                    if duration is not None and not self._has_state:
                        self._ends_at = first_cycle + duration
                    self._has_state = True
                    self._files.keep()
                    self.manager.ready()
                if self.memory.ended and duration is None:
                    self._stopping.set()
                if self._reload.step(self.state, self.phase, self.configuration):
                    self._commands.ask(Command.RAMP_OUT)  # not a person's request
                if (self._stopping.is_set() or self._reload.wants_end) and stop_by is None:
                    stop_by = self._clock.monotonic() + self._longest_stop
                    if self._stopping.is_set():
                        self.manager.stopping()
                    loop.ask_to_stop()
                detail = ""
                if loop.hangs:
                    detail = f"no heartbeat of the loop for {self.memory.silence:.2f} s: killed"
                elif stop_by is not None and self._clock.monotonic() > stop_by:
                    detail = f"the loop has not stopped within {self._longest_stop:.1f} s: killed"
                if detail:
                    loop.kill()  # reported after its end: nothing is written any more
                    self._fault("hang", detail)
            self._read_loop()
            self._on_loop_end(loop.outcome, f"the loop's process {loop.describe_end()}")
            if first_cycle is not None and self._clock.monotonic() - first_cycle > HEALTHY:
                self._wait = self.settings.backoff[0]
        except Exception:  # of the daemon itself: the arm is not left where it is
            ramp_out(loop, self._longest_stop, self.manager.kick, self._clock)
            raise
        finally:
            self.loop = None
            loop.close()

    @property
    def _longest_stop(self) -> float:
        """Return s from a request to stop until the loop is killed."""
        return STOP_TIMEOUT + longest_ramp_out(self.settings.limits) + STOP_MARGIN

    def _start_loop(self, armed_by: str, since: int) -> LoopProcess:
        """Start a process of the loop, which receives only requests made from now on.

        In addition, requests other than to arm that no loop has received are repeated. It arms by
        itself for ``armed_by``, unless someone has disarmed after the request ``since``. Raises
        OSError if no process can be started.
        """
        after = self._requests.forward_all()
        order = {
            "may_write": self.may_write, "number": self._loops, "latched": self._status.latched,
            "after": after,
        }  # fmt: skip
        self._requests.repeat(self.memory.last_taken)
        if armed_by and self.may_write:
            self._requests.arm_unless_disarmed(armed_by, since)
        self._loops += 1
        return self.loop_process(
            self.configuration, self.memory, self._commands, order, self._files.log, self._clock
        )

    def _read_loop(self) -> None:
        """Read cycles and events of the loop."""
        last_taken = self.memory.last_taken
        # in this order: when an event is emitted, its state and rows are up to date
        events = [] if self.loop is None else self.loop.events()
        if self.loop is not None:
            self._last_state = State(self.memory.state)
        self._last_taken = last_taken
        rows = self._reader.drain()
        self.tally.add(rows)
        self._status.take(rows)
        for event in events:
            self.event_log.add(event)
        for detail in self._fitted.take(rows, self._clock.monotonic()):
            self.event_log.add(
                {"kind": EventKind.WARNING, "what": "outside_fitted", "detail": detail}
            )
        self._zeros.take(rows)

    def _on_event(self, event: Event) -> None:
        """Act on an event, and print it on the terminal."""
        kind, detail = event["kind"], str(event.get("detail", ""))
        self._status.on_event(event)
        self._zeros.kept.on_event(event)
        self._note_latched()
        self._reload.on_event(event)
        if kind == EventKind.FAILURE:
            self._failure = event
        if kind == EventKind.REFUSED:
            self._refused = True
        if kind == EventKind.RECORDER:
            self.lost_rows += int(event.get("lost", 0))
        if kind == EventKind.TRANSITION:
            tail = f": {detail}" if detail else ""
            text = f"{event['from'].lower()} -> {event['to'].lower()} ({event['cause']}){tail}"
            self._say(text)
            self._refused |= event["cause"] == Cause.START_REFUSED
            if detail:
                self._faults.add(event["cause"], text)
        elif detail and kind not in NOT_SHOWN:
            self._say(detail)

    def _on_loop_end(self, code: int | None, how: str) -> None:
        """Act on the end of the loop's process; raises if a restart is useless.

        ``code``: its exit code, None if it could not be started. ``how`` it ended, as text.
        """
        if code == Exit.DONE:
            if not self._reload.wants_end:
                self._stopping.set()
            return
        self._last_state = State.DISCONNECTED
        self._status.lost_loop()
        detail = str(self._failure.get("detail", "")) or how
        if self._stopping.is_set() and not self._failure:
            return
        if code == Exit.INPUT and not self._has_state:
            raise InputError(detail)  # later, a file may be in the middle of an edit: retry
        if not self._has_state:
            if code != Exit.LINK:  # it failed, or was killed: how is in its log
                self._files.keep()
            raise LinkError(detail)
        self._fault("loop", detail)

    def _fault(self, cause: str, detail: str) -> None:
        self._faults.add(cause, detail)
        self.event_log.add({"kind": EventKind.FAULT, "cause": cause, "detail": detail})

    def _summary(self) -> RunSummary:
        state = self._last_state
        failed = self._refused and not self.tally.counts.written
        failed |= state in (State.FAULT, State.DISCONNECTED)
        summary = RunSummary(
            **self.tally.figures(),
            restarts=self.restarts,
            lost_rows=self.lost_rows,
            faults=self._faults.texts,
            state=state.name.lower(),
            exit_code=1 if failed else 0,
            recording=self.recording,
            cause=self._faults.cause,
        )
        self.event_log.add({"kind": EventKind.SUMMARY, "summary": summary.to_json()})
        return summary
