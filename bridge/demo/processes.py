"""Child processes of the demo: ``gapbridge simulate`` and ``gapbridge diagnose``."""

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

from gapbridge.bridge.ipc.side_process import environment
from gapbridge.core.errors import LinkError, RunError

PR_SET_PDEATHSIG = 1  # prctl's
START_LIMIT = 40.0  # s
STOP_LIMIT = 5.0  # s
MAX_DURATION = 900.0  # s, also on a machine that stalls
NICENESS = 10  # below the control loop


class ServedCell:
    """The simulated controller of a cell, running while the ``with`` block lasts."""

    def __init__(self, cell: Path, seed: int) -> None:
        self._command = [
            sys.executable, "-m", "gapbridge", "simulate", str(cell), "--seed", str(seed),
        ]  # fmt: skip
        self._process: subprocess.Popen[str] | None = None
        self._lines: list[str] = []

    def __enter__(self) -> Self:
        """Start it and wait until it serves. Raises LinkError with its last line of output."""
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, env=environment(), start_new_session=True,
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
        """Read its output to the end: a full pipe would block it."""
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
    """Have the kernel end the controller with the demo, however that ends, to free its ports."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


class DiagnosisProcess:
    """``gapbridge diagnose``, running in the background while the ``with`` block lasts."""

    def __init__(self, log: Path, cell: Path, out: Path, new_cell: Path) -> None:
        self._command = [
            sys.executable, "-m", "gapbridge", "diagnose", str(log), "--cell", str(cell),
            "--out", str(out), "--apply", str(new_cell),
        ]  # fmt: skip
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            stdin=subprocess.DEVNULL, env=environment(), preexec_fn=lambda: os.nice(NICENESS),
        )  # fmt: skip
        return self

    def output(self) -> str:
        """Wait for the end and return what was printed. Raises RunError where it failed."""
        assert self._process is not None
        try:
            output, _ = self._process.communicate(timeout=MAX_DURATION)
        except subprocess.TimeoutExpired:
            raise RunError(f"the diagnosis did not end within {MAX_DURATION:g} s") from None
        if self._process.returncode:
            raise RunError(f"the diagnosis failed: {output.strip()[-300:]}")
        return output.strip()

    def __exit__(self, *_: object) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()
