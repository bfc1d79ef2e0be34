"""The daemon's view of the loop's process: start it, watch its heartbeat, end it."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import IO, Any

from gapbridge.bridge.cell.run_settings import Configuration
from gapbridge.bridge.ipc.command_memory import Command, CommandMemory
from gapbridge.bridge.ipc.sealed_memory import sealed_bytes
from gapbridge.bridge.ipc.shared_memory import Phase, RunMemory
from gapbridge.bridge.ipc.side_process import environment
from gapbridge.bridge.loop.loop import Exit
from gapbridge.drivers.clock import Clock

STARTING_LIMIT = 180.0  # s: imports and, the first time, compilation
ENDING_LIMIT = 2.0  # s
LOOK_EVERY = 0.02  # s
_LONGEST_EVENT = 65536  # bytes


class LoopProcess:
    """One process of the loop, from its start to its end.

    It gets the files of its configuration as the daemon has read them, and reads no others.
    ``order`` holds ``may_write``, ``number`` (of the process, from 0), ``latched`` and ``after``
    (number of the last request that is not for it); see bridge/loop/main.py. Raises OSError if no
    process can be started.
    """

    _cut_short = False  # killed on request, before it was connected

    def __init__(
        self, configuration: Configuration, memory: RunMemory, commands: CommandMemory,
        order: dict[str, Any], log: IO[Any] | int, clock: Clock,
    ) -> None:  # fmt: skip
        self._now = clock.monotonic
        memory.renew()
        self.memory, self._commands = memory, commands
        self._settings = settings = configuration.settings
        self.started = self._now()
        with ExitStack() as stack:
            files = sealed_bytes("gapbridge-files", pickle.dumps(dict(configuration.files)))
            stack.callback(os.close, files)
            # sockets, not pipes: they cannot be opened again through /proc
            events, remote = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            stack.enter_context(remote)
            kept = stack.enter_context(ExitStack())  # closed only where no process is started
            kept.enter_context(events)
            orders, stdin = map(stack.enter_context, socket.socketpair())
            # spawned, not forked: no threads and locks are inherited; in a new session, so that
            # Ctrl-C reaches only the daemon
            self._process = subprocess.Popen(
                [sys.executable, "-X", "faulthandler", "-m", "gapbridge.bridge.loop.main"],
                stdin=stdin.fileno(), stdout=log, stderr=log, env=environment(),
                pass_fds=(memory.fd, commands.fd, files, remote.fileno()), start_new_session=True,
            )  # fmt: skip
            kept.pop_all()
            self._events = events
            events.setblocking(False)
            order = {
                **order, "settings": settings.model_dump(mode="json"), "n": memory.n,
                "memory": memory.fd, "commands": commands.fd, "events": remote.fileno(),
                "files": files, "hash": configuration.hash,
                "parent": os.getpid(),
            }  # fmt: skip
            stdin.close()  # else nobody notices that it has ended
            with contextlib.suppress(OSError):  # it has, which the daemon detects
                orders.sendall((json.dumps(order) + "\n").encode())

    @property
    def pid(self) -> int:
        """Return its process id."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """Return its exit code, negative for a signal; None while it lives."""
        return self._process.poll()

    @property
    def outcome(self) -> int | None:
        """Return its exit code, DONE where it was only to end and had not been connected."""
        return Exit.DONE if self._cut_short else self.exit_code

    @property
    def hangs(self) -> bool:
        """Return whether its heartbeat has stopped for longer than its phase allows."""
        memory, settings = self.memory, self._settings
        limit = {
            Phase.STARTING: STARTING_LIMIT,
            Phase.CONNECTING: settings.link.connect_timeout,
            Phase.RUNNING: settings.hang_timeout,
            Phase.ARMING: settings.link.connect_timeout,
            Phase.ENDING: ENDING_LIMIT,
        }[memory.phase]
        silence = memory.silence or self._now() - self.started
        return silence > limit

    def events(self) -> list[dict[str, Any]]:
        """Return the events that have arrived."""
        events = []
        with contextlib.suppress(OSError):
            while data := self._events.recv(_LONGEST_EVENT):
                events.append(json.loads(data))
        return events

    def ask_to_stop(self) -> None:
        """Request it to ramp out and end."""
        self._commands.ask(Command.STOP)
        if self.memory.phase in (Phase.STARTING, Phase.CONNECTING) and self.exit_code is None:
            self._cut_short = True
            self.kill()  # nothing is written yet, and connecting cannot be interrupted

    def kill(self) -> None:
        """Kill it; the robot's watchdog stops the arm."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGKILL)
            self._process.wait()

    def close(self) -> None:
        """Kill the process if it runs, and close its socket."""
        self.kill()
        self._events.close()

    def describe_end(self) -> str:
        """Return how it ended, as text."""
        code = self.exit_code
        if code is None:
            return "is alive"
        if code < 0:
            return f"was ended by {signal.Signals(-code).name}"
        known = {e.value: e.name.lower() for e in Exit}
        return f"ended with {code} ({known.get(code, 'unknown')})"


def ramp_out(
    loop: LoopProcess, seconds: float, meanwhile: Callable[[], object], clock: Clock
) -> None:
    """Ask a loop to stop, and wait until it has: for ``seconds`` s, unless it hangs."""
    loop.ask_to_stop()
    until = clock.monotonic() + seconds
    while loop.exit_code is None and clock.monotonic() < until:
        meanwhile()
        clock.sleep(LOOK_EVERY)
        if loop.hangs:
            return
