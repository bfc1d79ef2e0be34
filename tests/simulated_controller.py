"""A simulated UR controller with any settings as a child process; run as a script, the child."""

from __future__ import annotations

import logging
import os
import pickle
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from typing import IO, Self

from gapbridge.core.errors import GapbridgeError, LinkError
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.simulated.ur.server import serve
from gapbridge.drivers.simulated.ur.settings import ServerSettings

START_LIMIT = 90.0  # s
STOP_LIMIT = 3.0  # s


@dataclass(slots=True)
class _Running:
    process: subprocess.Popen[bytes]
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
        if self._running is None:
            raise LinkError("the simulated controller is not running")
        return self._running.process.pid

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
        path = os.pathsep.join(p for p in sys.path if p)
        process = subprocess.Popen(
            [sys.executable, __file__, self._log_level],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
            env={**os.environ, "PYTHONPATH": path}, start_new_session=True,
        )  # fmt: skip
        self._running = _Running(process, errors)
        assert process.stdin is not None
        try:
            pickle.dump(self.settings, process.stdin)
            process.stdin.flush()
        except BrokenPipeError:
            pass  # the reason stands in its log
        self._wait_ready(process)

    def _wait_ready(self, process: subprocess.Popen[bytes]) -> None:
        lines: queue.Queue[bytes] = queue.Queue()
        assert process.stdout is not None
        stdout = process.stdout
        threading.Thread(target=lambda: lines.put(stdout.readline()), daemon=True).start()
        try:
            line = lines.get(timeout=START_LIMIT)
        except queue.Empty:
            line = b""
        if not line.startswith(b"ready"):
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


def main(log_level: str) -> int:
    """Serve the settings that come through stdin, until SIGTERM, SIGINT or the end of stdin."""
    logging.basicConfig(level=log_level, stream=sys.stderr)
    stopped: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda n, _: stopped.append(n))
    settings = pickle.load(sys.stdin.buffer)

    def wait_for_parent() -> None:
        # unbuffered: a daemon thread in a buffered read ends Python badly
        while os.read(sys.stdin.fileno(), 4096):
            pass  # what an attack on the pipes of a run has written
        stopped.append(0)

    threading.Thread(target=wait_for_parent, daemon=True).start()
    try:
        serve(settings, SYSTEM, lambda: bool(stopped))
    except GapbridgeError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
