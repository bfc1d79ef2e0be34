"""The simulated controller of a cell in a process of its own, which can be stopped and killed."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.faults.punctual import go_first

START_LIMIT = 180.0  # s
CODE = """
import contextlib, ctypes, signal
with contextlib.suppress(Exception):  # it must not outlive whoever started it
    ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)
from gapbridge.bridge.cli import main
main()
"""


class ControllerProcess:
    """``gapbridge simulate CELL``: start, stand still, go on, die, come back."""

    def __init__(self, cell: Path, host: str, bench_port: int, log: Path) -> None:
        self._cell, self._log = cell, log
        self._bench = (host, bench_port)
        self._process: subprocess.Popen[bytes] | None = None
        self._still = False

    @property
    def pid(self) -> int:
        """Return its process id. Raises ProcessLookupError where it is dead."""
        if self._process is None:
            raise ProcessLookupError("the simulated controller is dead")
        return self._process.pid

    def start(self) -> None:
        """Start it and wait until it serves."""
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", CODE, "simulate", str(self._cell)],
                stdout=subprocess.PIPE, stderr=log, env=environment, start_new_session=True,
            )  # fmt: skip
        go_first(self._process.pid)
        self._still = False
        until = time.monotonic() + START_LIMIT
        output = b""
        assert self._process.stdout is not None
        while b"ready" not in output:
            if not select.select([self._process.stdout], [], [], until - time.monotonic())[0]:
                raise TimeoutError(f"the simulated controller did not start: {output!r}")
            more = os.read(self._process.stdout.fileno(), 4096)
            if not more:
                message = self._log.read_text(errors="replace")[-300:]
                raise RuntimeError(f"the simulated controller ended: {message}")
            output += more

    def stand_still(self) -> None:
        """SIGSTOP. Raises ProcessLookupError where it is dead."""
        os.kill(self.pid, signal.SIGSTOP)
        self._still = True

    def go_on(self) -> None:
        """SIGCONT."""
        if self._still:
            self._still = False
            os.kill(self.pid, signal.SIGCONT)

    def kill(self) -> None:
        """SIGKILL, and wait for its end."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            assert self._process.stdout is not None
            self._process.stdout.close()
            self._process, self._still = None, False

    @property
    def runs(self) -> bool:
        """Return whether it lives."""
        return self._process is not None and self._process.poll() is None

    def bench(self, line: str) -> str:
        """Say a line to the bench beside it; returns the answer."""
        with socket.create_connection(self._bench, timeout=5.0) as link:
            link.sendall(line.encode() + b"\n")
            answer = link.makefile("r").readline().strip()
        if answer.startswith("error"):
            raise ValueError(f"bench: {line}: {answer}")
        return answer

    def stop(self) -> None:
        """End it."""
        with contextlib.suppress(ProcessLookupError):
            self.go_on()
        self.kill()
