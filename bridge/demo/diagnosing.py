"""The diagnosis of the calibration log, by the command that users have, while the arm moves on."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Self

from gapbridge.core.errors import RunError

LONGEST = 900.0  # s, on a machine that stalls
POLITE = 10  # niceness: the loop comes first


class Diagnosing:
    """``gapbridge diagnose`` as a process of its own while the ``with`` block lasts."""

    def __init__(self, log: Path, cell: Path, out: Path, new_cell: Path) -> None:
        self._command = [
            sys.executable, "-m", "gapbridge", "diagnose", str(log), "--cell", str(cell),
            "--out", str(out), "--apply", str(new_cell),
        ]  # fmt: skip
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            stdin=subprocess.DEVNULL, env=environment, preexec_fn=_be_polite,
        )  # fmt: skip
        return self

    def answer(self) -> str:
        """Wait for the answer in plain sentences. Raises RunError where there is none."""
        assert self._process is not None
        try:
            output, _ = self._process.communicate(timeout=LONGEST)
        except subprocess.TimeoutExpired:
            raise RunError(f"the diagnosis did not end within {LONGEST:g} s") from None
        if self._process.returncode:
            raise RunError(f"the diagnosis failed: {output.strip()[-300:]}")
        return output.strip()

    def __exit__(self, *_: object) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()


def _be_polite() -> None:
    os.nice(POLITE)
