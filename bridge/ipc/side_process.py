"""The daemon's part of a side process: start it, send it events, restart it.

The daemon never waits for a side process, whether it hangs, dies or stops reading.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
import subprocess
import sys
import termios
from contextlib import ExitStack
from typing import IO, Any

from gapbridge.bridge.ipc.sealed_memory import sealed_bytes
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.ipc.side_main import EventLines, EventWriter
from gapbridge.drivers.clock import Clock

BACKOFF = (0.2, 10.0)  # s before a restart: first, most
HEALTHY = 10.0  # s of running after which the backoff is reset
STALLED = 10.0  # s without reading events after which a process counts as stalled
STARTING = 60.0  # s, before it has read for the first time: imports on a busy machine
PIPE_SIZE = 1 << 18  # bytes


class SideProcess:
    """``python -m module``, restarted with backoff if it dies, stalls or cannot be started.

    ``start_data`` holds ``settings`` (a DaemonSettings as JSON), ``n``, ``session`` and
    ``extra``; see side_main.StartData.
    """

    def __init__(
        self, module: str, start_data: dict[str, Any], memory: SharedMemory,
        clock: Clock, log: IO[Any] | int = -3,
    ) -> None:  # fmt: skip
        self._now = clock.monotonic
        self.module, self.start_data = module, start_data
        self.restarts = 0
        self.stalls = 0
        self._dropped = 0
        self._memory, self._log = memory, log
        self._process: subprocess.Popen[bytes] | None = None
        self._down_fd: int | None = None  # None between two processes, as all that follows
        self._unshown = False  # it has not got the newest memory
        self._wait = BACKOFF[0]
        self._retry_at = 0.0  # s, monotonic
        self._problem = self._start()  # not reported yet

    @property
    def pid(self) -> int | None:
        """Return its process id; None between two of them."""
        return None if self._process is None else self._process.pid

    @property
    def dropped(self) -> int:
        """Return how many events it did not get because it did not read."""
        return self._dropped + (0 if self._down_fd is None else self._down.dropped)

    def emit(self, event: dict[str, Any]) -> None:
        """Send an event; if the pipe is full, the event is dropped and counted."""
        if self._down_fd is None:
            self._dropped += 1
        else:
            self._down.emit(event)

    def show(self, memory: SharedMemory) -> None:
        """Switch it to another memory; after a restart it uses that one."""
        self._memory = memory
        if self._process is None:
            return
        self._unshown = True
        with contextlib.suppress(OSError), ExitStack() as stack:  # else ``check`` tries again
            fd = memory.open_for_reading()
            stack.callback(os.close, fd)
            socket.send_fds(self._successors, [b"p"], [fd])
            self._unshown = False

    def events(self) -> list[dict[str, Any]]:
        """Return the events that it has reported."""
        return [] if self._process is None else self._up.poll()

    def check(self) -> str | None:
        """Check it and restart it if needed; returns its problem as text, or None."""
        now = self._now()
        if self._process is None:
            problem, self._problem = self._problem, None
            if problem is None and now >= self._retry_at:
                self.restarts += 1
                return self._start()
            return problem
        code = self._process.poll()
        if code is None:
            if self._unshown:
                self.show(self._memory)
            return self._check_reading(now)
        self._release()
        if now - self._started > HEALTHY:
            self._wait = BACKOFF[0]
        self._pause()
        return f"{self.module} ended with {code}"

    def close(self, timeout: float = 3.0) -> tuple[list[dict[str, Any]], str | None]:
        """Notify it that the daemon ends, give it ``timeout`` s to finish, then end it.

        Returns its last events, and as text how it failed to finish, or None.
        """
        self.begin_close()
        if self._process is None:
            return [], f"{self.module} was not running at the end"
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout)
        code = self._process.poll()
        self._process.kill()
        self._process.wait()
        last = self._up.poll()
        self._release()
        if code is None:
            return last, f"{self.module} did not finish within {timeout:g} s and was killed"
        return last, f"{self.module} ended with {code}" if code else None

    def begin_close(self) -> None:
        """Notify it that the daemon ends, without waiting."""
        if self._process is not None:
            self._close_down()

    # -- inside -----------------------------------------------------------------------------------

    def _pause(self) -> None:
        """Wait before the next start, longer each time."""
        self._retry_at = self._now() + self._wait
        self._wait = min(2.0 * self._wait, BACKOFF[1])

    def _start(self) -> str | None:
        """Start it; returns as text why it cannot be started, or None."""
        try:
            self._spawn()
        except OSError as error:  # memory, processes or descriptors are short
            self._pause()
            return f"{self.module} cannot be started: {error.strerror}"
        return None

    def _spawn(self) -> None:
        """Start the process. Raises OSError; then nothing stays open."""
        with ExitStack() as ours, ExitStack() as passed:

            def held(stack: ExitStack, fd: int) -> int:
                stack.callback(os.close, fd)
                return fd

            read, write = os.pipe()
            down_read, down_write = held(passed, read), held(ours, write)
            read, write = os.pipe()
            up_read, up_write = held(ours, read), held(passed, write)
            with contextlib.suppress(OSError):
                fcntl.fcntl(down_write, fcntl.F_SETPIPE_SZ, PIPE_SIZE)
            memory = held(passed, self._memory.open_for_reading())
            successors, remote = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            ours.enter_context(successors)
            passed.enter_context(remote)
            fds = (down_read, up_write, memory, remote.fileno())
            start_data = {
                **self.start_data, "memory": memory, "events": down_read, "up": up_write,
                "successors": fds[3],
            }  # fmt: skip
            # memory, not a pipe: however much it is, nobody waits until it has been read
            text = (json.dumps(start_data) + "\n").encode()
            stdin = held(passed, sealed_bytes("gapbridge-start", text))
            # spawned, not forked; in a new session, so that Ctrl-C reaches only the daemon, which
            # then ends it
            process = subprocess.Popen(
                [sys.executable, "-X", "faulthandler", "-m", self.module],
                stdin=stdin, stdout=self._log, stderr=self._log, env=environment(),
                pass_fds=fds, start_new_session=True,
            )  # fmt: skip
            ours.pop_all()
        successors.setblocking(False)
        self._process, self._successors, self._unshown = process, successors, False
        self._down_fd = down_write
        self._down, self._up = EventWriter(down_write), EventLines(up_read)
        self._started = self._read_at = self._now()
        self._has_read = False

    def _check_reading(self, now: float) -> str | None:
        """Kill it if it has not emptied its pipe for too long."""
        assert self._process is not None
        if self._down_fd is None:
            return None
        unread = int.from_bytes(
            fcntl.ioctl(self._down_fd, termios.FIONREAD, b"\0" * 4), sys.byteorder
        )
        if unread == 0:
            self._read_at = now
            self._has_read = self._has_read or self._down.sent > 0
        timeout = STALLED if self._has_read else STARTING
        if now - self._read_at < timeout:
            return None
        self.stalls += 1
        self._process.kill()
        return f"{self.module} read nothing for {now - self._read_at:.0f} s and was killed"

    def _close_down(self) -> None:
        if self._down_fd is not None:
            self._dropped += self._down.take_dropped()
            os.close(self._down_fd)
            self._down_fd = None

    def _release(self) -> None:
        self._process = None
        self._close_down()
        self._up.close()
        self._successors.close()


def environment() -> dict[str, str]:
    """Return the environment with this interpreter's import path, and one thread for algebra."""
    variables = dict(os.environ)
    variables["PYTHONPATH"] = os.pathsep.join(p for p in sys.path if p)
    variables["PYTHONSAFEPATH"] = "1"  # else ``-m`` imports first what lies in the working folder
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        variables[name] = "1"
    variables.pop("NOTIFY_SOCKET", None)  # only the daemon itself speaks to the service manager
    return variables
