"""The daemon's view of the loop's process: start it, watch its heartbeat, end it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from typing import IO, Any

from bridge.cell.daemon_settings import DaemonSettings
from bridge.ipc.shared_memory import Command, Page, Phase
from bridge.ipc.side_process import environment
from bridge.loop.loop import Exit

STARTING_LIMIT = 180.0  # s: imports and, the first time, compilation
ENDING_LIMIT = 2.0  # s
_LONGEST_LINE = 65536


class LoopProcess:
    """One process of the loop, from its start to its end; ``number`` counts them from 0."""

    def __init__(
        self, settings: DaemonSettings, page: Page, arm: bool, may_write: bool,
        log: IO[Any] | int, number: int = 0, latched: str = "",
    ) -> None:  # fmt: skip
        page.renew()
        self.page = page
        self._settings = settings
        self._events, theirs = os.pipe()
        os.set_blocking(self._events, False)
        self._rest = b""
        self.started = time.monotonic()
        order = {
            "settings": settings.model_dump(mode="json"), "n": page.n, "arm": arm, "number": number,
            "latched": latched,
            "may_write": may_write, "page": self.page.fd, "events": theirs, "parent": os.getpid(),
        }  # fmt: skip
        try:
            # spawned, never forked: nothing of this process's threads and locks may be inherited;
            # in a session of its own, so that a Ctrl-C reaches it through the daemon only
            self._process = subprocess.Popen(
                [sys.executable, "-X", "faulthandler", "-m", "bridge.loop.main"],
                stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment(),
                pass_fds=(self.page.fd, theirs), start_new_session=True,
            )  # fmt: skip
        finally:
            os.close(theirs)
        assert self._process.stdin is not None
        try:
            self._process.stdin.write((json.dumps(order) + "\n").encode())
            self._process.stdin.close()
        except BrokenPipeError:
            pass  # it is gone already, which the daemon sees

    @property
    def pid(self) -> int:
        """Return its process id."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """Return its exit code, negative for a signal; None while it lives."""
        return self._process.poll()

    @property
    def hangs(self) -> bool:
        """Return whether its heartbeat has stood still for longer than what it is at may take."""
        page, settings = self.page, self._settings
        limit = {
            Phase.STARTING: STARTING_LIMIT,
            Phase.CONNECTING: settings.link.connect_timeout,
            Phase.RUNNING: settings.hang_timeout,
            Phase.ARMING: settings.link.connect_timeout,
            Phase.ENDING: ENDING_LIMIT,
        }[page.phase]
        silence = page.silence or time.monotonic() - self.started
        return silence > limit

    def events(self) -> list[dict[str, Any]]:
        """Return the events that have arrived."""
        try:
            data = os.read(self._events, _LONGEST_LINE)
        except BlockingIOError:
            return []
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [json.loads(line) for line in lines if line]

    def ask_to_stop(self) -> None:
        """Ask it to ramp out and end."""
        self.page.ask(Command.STOP)
        if self.page.phase in (Phase.STARTING, Phase.CONNECTING):
            self.kill()  # nothing is written yet, and a constructor cannot be interrupted

    def kill(self) -> None:
        """End it by force; the robot's own watchdog stops the arm."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGKILL)
            self._process.wait()

    def close(self) -> None:
        """Give everything back; ends the process where it still lives."""
        self.kill()
        os.close(self._events)

    def describe_end(self) -> str:
        """Return in words how it ended."""
        code = self.exit_code
        if code is None:
            return "is alive"
        if code < 0:
            return f"was ended by {signal.Signals(-code).name}"
        known = {e.value: e.name.lower() for e in Exit}
        return f"ended with {code} ({known.get(code, 'unknown')})"
