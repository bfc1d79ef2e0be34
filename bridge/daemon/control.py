"""The daemon's answers over its local socket; every request emits an event."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from gapbridge.bridge.cell.runtime_folder import cell_key, runtime_folder
from gapbridge.bridge.ipc.control_socket import ControlSocket, Peer, refusal
from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import Phase
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.core.errors import InputError, first_line
from gapbridge.drivers.clock import Clock

LONGEST_ARMING = 25.0  # s: uploads a program to the robot
LONGEST_RAMP = 20.0  # s
LONGEST_PICKUP = 20.0  # s until a loop receives a request: a new one may have to start
SOURCE_SILENT = 1.0  # s without a first setpoint after which "armed; waits" is answered
POLL_EVERY = 0.02  # s
ARMED = State.ARMED.name


class Controlled(Protocol):
    """The part of the daemon that requests use, from other threads."""

    @property
    def state(self) -> State:
        """Return the state of the loop."""

    @property
    def phase(self) -> Phase:
        """Return the phase of the loop's process."""

    @property
    def armed_by(self) -> str:
        """Return who armed; empty: it is not armed, by the events so far."""

    @property
    def latched(self) -> str:
        """Return the latched fault, not acknowledged yet; empty: none."""

    @property
    def mark_problem(self) -> str:
        """Return why an acknowledged mark of a failed verification is still there; empty: no."""

    @property
    def may_write(self) -> bool:
        """Return whether arming is possible at all."""

    @property
    def sequence(self) -> int:
        """Return the number of the last event."""

    def events_since(self, sequence: int) -> list[Event]:
        """Return the events after a number."""

    def status(self) -> dict[str, Any]:
        """Return the status document."""

    @property
    def last_taken(self) -> int:
        """Return the number of the newest request that a loop has received."""

    def arm(self, by: str) -> int:
        """Request writing; returns the request's number, 0 if it cannot be made."""

    def disarm(self, by: str) -> int:
        """Request ramping out, or acknowledge a fault; returns the request's number."""

    def note(self, event: Event) -> None:
        """Emit an event."""


class Control:
    """Answers requests; ``answer`` may take as long as arming or ramping out."""

    def __init__(self, daemon: Controlled, clock: Clock) -> None:
        self._daemon, self._clock = daemon, clock

    @contextmanager
    def socket(self, cell: Path) -> Iterator[None]:
        """Answer at a cell's socket while the ``with`` block lasts. Raises InputError."""
        path = runtime_folder() / f"{cell_key(cell)}.sock"
        listener = ControlSocket(path, self.answer, self._clock)
        try:
            listener.open()
        except OSError as error:
            if error.errno == errno.EADDRINUSE:  # else the lock of the link would have been taken
                raise InputError(
                    f"{cell}: found another daemon that runs this cell file, with another link; "
                    "expected one a file: end that one first, or copy the file"
                ) from None
            detail = f"{listener.path}: {first_line(error)}, expected a socket to listen on"
            raise InputError(detail) from None
        try:
            yield
        finally:
            listener.close()

    def answer(self, command: str, peer: Peer) -> dict[str, Any]:
        """Return the answer to a command of COMMANDS."""
        if command == "status":
            return {"ok": True, "answer": self._daemon.status()}
        by = f"uid {peer.uid}, pid {peer.pid}"
        reply = self._arm(by) if command == "arm" else self._disarm(by)
        self._daemon.note(
            {"kind": EventKind.CONTROL, "command": command, "uid": peer.uid, "pid": peer.pid,
             "ok": reply["ok"],
             "detail": f"{command} by {by}: {reply.get('answer') or reply.get('error')}"}
        )  # fmt: skip
        return reply

    def _arm(self, by: str) -> dict[str, Any]:
        daemon = self._daemon
        if not daemon.may_write:
            return refusal("found a daemon that only observes (--observe), expected one that may")
        if daemon.state in (State.ARMED, State.COMPENSATING):
            return _done(f"is {daemon.state.name.lower()} already")
        if daemon.latched:
            return refusal(
                f"a fault is latched: {daemon.latched}; acknowledge it first: gapbridge disarm"
            )
        if daemon.state != State.OBSERVING:
            return refusal(f"found state {daemon.state.name.lower()}, expected observing")
        mark = daemon.sequence
        if not daemon.arm(by):
            return refusal("the loop has ended, expected one that observes")
        return self._await_armed(mark, by)

    def _await_armed(self, mark: int, by: str) -> dict[str, Any]:
        daemon, begun, waiting = self._daemon, self._clock.monotonic(), None
        while self._clock.monotonic() - begun < LONGEST_ARMING:
            for event in daemon.events_since(mark):
                if event["kind"] == EventKind.REFUSED or event.get("cause") == Cause.START_REFUSED:
                    return refusal(f"refused: {event['detail']}")
                given_up = (event.get("from"), event.get("to")) == (ARMED, State.OBSERVING.name)
                if given_up or event.get("to") in (State.FAULT.name, State.DISCONNECTED.name):
                    return refusal(f"{event['cause']}: {event['detail']}")
                if event.get("to") == State.COMPENSATING.name:
                    return _done("compensating")
            if daemon.state == State.DISCONNECTED:
                return refusal("the loop has ended before it was armed")
            idle = daemon.state == State.ARMED and daemon.phase == Phase.RUNNING
            waiting = (waiting or self._clock.monotonic()) if idle else None
            if waiting is not None and self._clock.monotonic() - waiting > SOURCE_SILENT:
                return _done("armed; waits for the first setpoint of its source")
            self._clock.sleep(POLL_EVERY)
        daemon.disarm(by)  # else it may arm later, when nobody expects it any more
        return refusal(
            f"no answer of the loop within {LONGEST_ARMING:g} s; the request is withdrawn"
        )

    def _disarm(self, by: str) -> dict[str, Any]:
        """Request it in any state, and answer what a loop has confirmed."""
        daemon = self._daemon
        observed = daemon.state == State.OBSERVING and not daemon.latched
        fault = daemon.latched
        number = daemon.disarm(by)
        if not self._wait_for(lambda: daemon.last_taken >= number, LONGEST_PICKUP):
            return refusal(
                f"no loop has taken it within {LONGEST_PICKUP:g} s (the state is "
                f"{daemon.state.name.lower()}); it is kept for the next one"
            )

        if problem := daemon.mark_problem:
            return refusal(problem)

        if self._await_observing(SOURCE_SILENT if fault else LONGEST_RAMP):
            if observed:
                return _done("is observing already")
            return _done(f"acknowledged ({fault}); observing" if fault else "observing")
        if fault:
            return _done(f"acknowledged ({fault}); observing as soon as the robot is fine")
        if new := daemon.latched:
            return refusal(
                f"a fault has occurred since: {new}; acknowledge it as well: gapbridge disarm"
            )
        return refusal(f"still {daemon.state.name.lower()} after {LONGEST_RAMP:g} s")

    def _await_observing(self, limit: float) -> bool:
        """Return whether it observes, by the loop's own event, which comes after its state.

        A fault that stands ends the wait; a link's ends when it is connected again.
        """
        daemon, until = self._daemon, self._clock.monotonic() + limit
        fault_at: float | None = None
        while (now := self._clock.monotonic()) <= until:
            if daemon.state == State.OBSERVING and not (daemon.latched or daemon.armed_by):
                return True
            in_fault = daemon.state == State.FAULT and daemon.latched
            fault_at = (fault_at or now) if in_fault else None
            if fault_at is not None and now - fault_at > SOURCE_SILENT:
                break
            self._clock.sleep(POLL_EVERY)
        return False

    def _wait_for(self, what: Callable[[], bool], limit: float) -> bool:
        until = self._clock.monotonic() + limit
        while not what():
            if self._clock.monotonic() > until:
                return False
            self._clock.sleep(POLL_EVERY)
        return True


def _done(detail: str) -> dict[str, Any]:
    return {"ok": True, "answer": detail}
