"""What persons and programs request of a run: queued, logged with who asked, then passed on."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import NamedTuple

from gapbridge.bridge.ipc.command_memory import Command, CommandMemory
from gapbridge.bridge.ipc.events import Event, EventKind

OUTLAST_LOOPS = (Command.DISARM, Command.RAMP_OUT, Command.ZERO_MOVED)
"""Commands that a new process of the loop receives if the last one did not."""


class _Request(NamedTuple):
    number: int
    command: Command
    by: str  # who or what asks
    known: tuple[str, ...]  # what said that zeros had moved when it was made


class Requests:
    """Requests to arm and disarm. ``make`` is for any thread, the rest for the daemon's own.

    ``emit`` adds an event. ``zeros_moved`` returns why joints' zeros are not trusted, as texts;
    empty: they are. DISARM acknowledges what was known when it was made, and none of it if there is
    more by the time it is passed on. ``obstacle_to`` returns why a command must not reach the loop,
    as text; empty: it may. It is given whether a zero had moved before the request was logged, and
    whether the request acknowledges that.
    """

    def __init__(
        self,
        commands: CommandMemory,
        emit: Callable[[Event], object],
        zeros_moved: Callable[[], tuple[str, ...]],
        obstacle_to: Callable[[Command, bool, bool], str],
    ) -> None:
        self._commands, self._emit = commands, emit
        self._zeros_moved, self._obstacle_to = zeros_moved, obstacle_to
        self._waiting: queue.SimpleQueue[_Request] = queue.SimpleQueue()
        self._lock = threading.RLock()
        self._disarmed = 0  # number of the last request to disarm

    def make(self, command: Command, by: str) -> int:
        """Queue a request; returns its number. ``by``: who or what asks."""
        known = self._zeros_moved()  # first: what is found from now on is not acknowledged
        with self._lock:
            number = self._commands.number()
            self._disarmed = self._disarmed if command == Command.ARM else number
            self._waiting.put(_Request(number, command, by, known))
        return number

    def forward(self) -> None:
        """Pass requests to the loop, each after an event that names the requester.

        Only this method writes an ARM command. Each call is a heartbeat for the loop.
        """
        self._commands.beat()
        while not self._waiting.empty():
            number, command, by, known = self._waiting.get()
            name = "arm" if command == Command.ARM else "disarm"
            moved = self._zeros_moved()
            acknowledges = command == Command.DISARM and all(
                what in ("", before) for what, before in zip(moved, known, strict=True)
            )
            self._emit(
                {"kind": EventKind.REQUEST, "command": name, "number": number, "by": by,
                 "acknowledges": acknowledges, "detail": f"{name} requested by {by}"}
            )  # fmt: skip
            if obstacle := self._obstacle_to(command, any(moved), acknowledges):
                self._emit({"kind": EventKind.REFUSED, "what": name, "detail": obstacle})
                continue
            self._commands.ask(command, number)

    def forward_all(self) -> int:
        """Pass on every request that is numbered; returns a number that all later ones exceed."""
        with self._lock:  # no request is numbered and not yet written
            self.forward()
            return self._commands.number()

    def arm_unless_disarmed(self, by: str, since: int) -> None:
        """Request arming, unless someone has requested to disarm after the request ``since``."""
        with self._lock:  # what is numbered from now on outlasts the arming
            if self._disarmed <= since:
                self.make(Command.ARM, by)
        self.forward()

    def repeat(self, last_taken: int) -> None:
        """Repeat requests other than to arm that no loop has received, in their order."""
        for command in sorted(OUTLAST_LOOPS, key=self._commands.last_of):
            if self._commands.last_of(command) > last_taken:
                self._commands.ask(command)
