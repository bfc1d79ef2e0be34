"""The simulated controller as a child process: start it, wait until it serves, end it."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from typing import IO, Self

from gapbridge.core.errors import LinkError
from gapbridge.drivers.simulated.ur.settings import ServerSettings, to_json

START_LIMIT = 20.0  # s
STOP_LIMIT = 3.0  # s


@dataclass(slots=True)
class _Running:
    process: subprocess.Popen[str]
    errors: IO[str]


class SimulatedController:
    """A simulated controller while the `with` block lasts.

    The server ends with the block, and with its parent: it watches the pipe it was started with.
    Raises LinkError where it does not come up, with its last words.
    """

    def __init__(self, settings: ServerSettings, log_level: str = "WARNING") -> None:
        self.settings = settings
        self.host = settings.host
        self._log_level = log_level
        self._running: _Running | None = None

    @property
    def pid(self) -> int:
        """Process id of the server."""
        return self._process().pid

    def log(self) -> str:
        """Return what the server has logged so far."""
        running = self._running
        if running is None:
            return ""
        running.errors.flush()
        with open(running.errors.name, encoding="utf-8") as lines:
            return lines.read()

    def start(self) -> None:
        """Start the server and wait until every port listens."""
        errors = tempfile.NamedTemporaryFile("w+", prefix="simulated-", suffix=".log")  # noqa: SIM115
        command = [sys.executable, "-m", "gapbridge.drivers.simulated", "--settings", "-"]
        process = subprocess.Popen(
            [*command, "--log", self._log_level],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True,
            env=_environment(), start_new_session=True,
        )  # fmt: skip
        self._running = _Running(process, errors)
        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(to_json(self.settings)) + "\n")
            process.stdin.flush()
        except BrokenPipeError:
            pass  # the reason stands in its log
        self._wait_ready(process)

    def _wait_ready(self, process: subprocess.Popen[str]) -> None:
        lines: queue.Queue[str] = queue.Queue()
        assert process.stdout is not None
        stdout = process.stdout
        threading.Thread(target=lambda: lines.put(stdout.readline()), daemon=True).start()
        try:
            line = lines.get(timeout=START_LIMIT)
        except queue.Empty:
            line = ""
        if not line.startswith("ready"):
            message = self.log().strip().splitlines()
            self.stop()
            raise LinkError(
                f"the simulated controller on {self.host} did not start: "
                f"{message[-1] if message else 'no message'}"
            )

    def stop(self) -> int:
        """End the server, by force where it does not obey; returns its exit code."""
        running, self._running = self._running, None
        if running is None:
            return 0
        process = running.process
        deadline = time.monotonic() + STOP_LIMIT
        process.terminate()
        try:
            code = process.wait(max(deadline - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
        for stream in (process.stdin, process.stdout, running.errors):
            if stream is not None:
                stream.close()
        return code

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _process(self) -> subprocess.Popen[str]:
        if self._running is None:
            raise LinkError("the simulated controller is not running")
        return self._running.process


def _environment() -> dict[str, str]:
    """Return the environment with this interpreter's import path."""
    environment = dict(os.environ)
    environment["PYTHONPATH"] = os.pathsep.join(p for p in sys.path if p)
    return environment
