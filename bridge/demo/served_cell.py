"""``gapbridge simulate`` as a process of its own: a cell's simulated controller."""

from __future__ import annotations

import ctypes
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Self

from gapbridge.core.errors import LinkError

PR_SET_PDEATHSIG = 1  # prctl's
START_LIMIT = 40.0  # s
STOP_LIMIT = 5.0  # s


class ServedCell:
    """The simulated controller of a cell while the ``with`` block lasts."""

    def __init__(self, cell: Path, seed: int) -> None:
        self._command = [
            sys.executable, "-m", "gapbridge", "simulate", str(cell), "--seed", str(seed),
        ]  # fmt: skip
        self._process: subprocess.Popen[str] | None = None
        self._lines: list[str] = []

    def __enter__(self) -> Self:
        """Start it and wait until it serves. Raises LinkError, with its last words."""
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, env=environment, start_new_session=True,
            preexec_fn=_end_with_parent,
        )  # fmt: skip
        lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, args=(lines,), daemon=True).start()
        until = time.monotonic() + START_LIMIT
        while True:
            try:
                line = lines.get(timeout=max(until - time.monotonic(), 0.0))
            except queue.Empty:
                line = ""
            if line.startswith("ready"):
                return self
            if not line:
                self._stop()
                last = self._lines[-1] if self._lines else "no message"
                raise LinkError(f"the simulated controller did not start: {last}")

    def _read(self, lines: queue.Queue[str]) -> None:
        """Take what it says, to its end: a full pipe would stop it."""
        assert self._process is not None
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines = [*self._lines[-20:], line.strip()]
            lines.put(line)
        lines.put("")

    def _stop(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        process.terminate()
        try:
            process.wait(STOP_LIMIT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def __exit__(self, *_: object) -> None:
        self._stop()


def _end_with_parent() -> None:
    """Have the kernel end the controller with the demo, however that ends: ports stay free."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
