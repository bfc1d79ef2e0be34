"""What persons and programs request of a run: queued, told with who asked, then passed on."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

from gapbridge.bridge.ipc.command_memory import Command, CommandMemory
from gapbridge.bridge.ipc.events import Event, EventKind

OUTLAST_LOOPS = (Command.DISARM, Command.RAMP_OUT, Command.ZERO_MOVED)
"""Commands that a new process of the loop receives if the last one did not."""


class Requests:
    """Requests to arm and disarm. ``make`` is for any thread, the rest for the daemon's own.

    ``emit`` adds an event. ``obstacle_to`` returns why a command must not reach the loop, as text,
    given what ``zero_moved`` says before the request is told; empty: it may.
    """

    def __init__(
        self,
        commands: CommandMemory,
        emit: Callable[[Event], object],
        zero_moved: Callable[[], str],
        obstacle_to: Callable[[Command, str], str],
    ) -> None:
        self._commands, self._emit = commands, emit
        self._zero_moved, self._obstacle_to = zero_moved, obstacle_to
        self._waiting: queue.SimpleQueue[tuple[int, Command, str]] = queue.SimpleQueue()
        self._lock = threading.RLock()

    def make(self, command: Command, by: str) -> int:
        """Queue a request; returns its number. ``by``: who or what asks."""
        with self._lock:
            number = self._commands.number()
            self._waiting.put((number, command, by))
        return number

    def forward(self) -> None:
        """Pass requests to the loop, each after an event that names the requester.

        Only this method writes an ARM command.
        """
        while not self._waiting.empty():
            number, command, by = self._waiting.get()
            name = "arm" if command == Command.ARM else "disarm"
            moved = self._zero_moved()
            self._emit(
                {"kind": EventKind.REQUEST, "command": name, "number": number, "by": by,
                 "acknowledges": command == Command.DISARM, "detail": f"{name} requested by {by}"}
            )  # fmt: skip
            if obstacle := self._obstacle_to(command, moved):
                self._emit({"kind": EventKind.REFUSED, "what": name, "detail": obstacle})
                continue
            self._commands.ask(command, number)

    def forward_all(self) -> int:
        """Pass on every request that is numbered; returns a number that all later ones exceed."""
        with self._lock:  # no request is numbered and not yet written
            self.forward()
            return self._commands.number()

    def repeat(self, last_taken: int) -> None:
        """Repeat requests other than to arm that no loop has received, in their order."""
        for command in sorted(OUTLAST_LOOPS, key=self._commands.last_of):
            if self._commands.last_of(command) > last_taken:
                self._commands.ask(command)
