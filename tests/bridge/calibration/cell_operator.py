"""An operator at the terminal, the pendant and the tracker of a simulated cell."""

from __future__ import annotations

import os
import re
import signal
import socket
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import pexpect
from numpy.typing import NDArray
from patience import PATIENCE

from gapbridge.core.estimation.registration import Registration
from gapbridge.core.rotation import rotation_matrix
from gapbridge.drivers.simulated.ur.settings import BENCH_PORT, SCRIPT_PORT

Array = NDArray[np.float64]
JOINT = re.compile(r"J\d ([+-][\d.]+)°")
COLOURS = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
FRAME = Registration(rotation_matrix(np.array([0.1, -0.2, 0.7])), np.array([2.5, -0.8, 0.3]))
TIMEOUT = 240.0  # s, on a busy machine


@dataclass
class CellOperator:
    """Controls of a simulated UR cell: bench, pendant and tracker."""

    host: str
    frame: Registration = FRAME  # of the tracker

    def bench(self, line: str) -> str:
        with socket.create_connection((self.host, BENCH_PORT), timeout=PATIENCE) as link:
            link.sendall(line.encode() + b"\n")
            answer = link.makefile().readline().strip()
        assert not answer.startswith("error"), answer
        return answer

    def pendant(self, program: str) -> None:
        with socket.create_connection((self.host, SCRIPT_PORT), timeout=PATIENCE) as link:
            link.sendall(program.encode())
            time.sleep(0.1)

    def mount(self, mass: float, cog: tuple[float, float, float], emit: bool = True) -> None:
        numbers = " ".join(f"{v:.6g}" for v in (mass, *cog))
        self.bench(f"payload {numbers}")
        if emit:
            reported = ",".join(f"{v:.6g}" for v in cog)
            self.pendant(f"def hang():\n  set_payload({mass:.6g}, [{reported}])\nend\n")

    def jog(self, q: Array) -> None:
        numbers = ",".join(f"{v:.9g}" for v in q)
        self.pendant(f"def go():\n  movej([{numbers}], a=8.0, v=2.5)\nend\n")

    def measure(self) -> Array:
        """Return the averaged reading of the tracker (3,), m, in its own frame."""
        samples = [[float(v) for v in self.bench("measure").split(",")[1:4]] for _ in range(10)]
        return np.mean(samples, axis=0) @ self.frame.rotation.T + self.frame.position


def _heed_interrupts() -> None:
    """Restore the handling of Ctrl-C, which shells disable for background jobs."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Terminal:
    """`gapbridge calibrate` in a terminal of its own."""

    def __init__(self, cell: Path, *arguments: object) -> None:
        self.command = [sys.executable, "-m", "gapbridge", "calibrate", str(cell)]
        self.command += [str(a) for a in arguments]
        self.shown = ""
        self._child: pexpect.spawn[str] | None = None

    def __enter__(self) -> Self:
        path = os.pathsep.join(p for p in sys.path if p)
        self._child = pexpect.spawn(
            self.command[0], self.command[1:], encoding="utf-8", timeout=TIMEOUT,
            env={**os.environ, "PYTHONPATH": path, "TERM": "xterm"}, dimensions=(50, 160),
            preexec_fn=_heed_interrupts,
        )  # fmt: skip
        self._child.delaybeforesend = None
        return self

    def __exit__(self, *_: object) -> None:
        child = self._child
        if child is not None and child.isalive():
            child.kill(signal.SIGKILL)
        if child is not None:
            child.close(force=True)

    def question(self) -> str | None:
        """Return the next question; None: the command has ended."""
        child, waited = self._child, ""
        assert child is not None
        while True:
            found = child.expect([r" > ", pexpect.EOF, pexpect.TIMEOUT])
            new = COLOURS.sub("", child.before + (child.after if found == 0 else ""))
            self.shown += new
            waited += new
            if found == 1:
                child.wait()
                return None
            assert found == 0, f"nothing for {TIMEOUT:g} s after: {self.shown[-1500:]}"
            line = re.split(r"[\r\n]+", waited)[-1]
            if line.endswith(" > "):
                return line[:-3].strip()

    def read_output(self) -> None:
        """Read the output that is available, or wait for some."""
        assert self._child is not None
        try:
            self.shown += COLOURS.sub("", self._child.read_nonblocking(4096, timeout=TIMEOUT))
        except pexpect.EOF:
            raise AssertionError(f"it ended: {self.shown[-1500:]}") from None

    def type(self, line: str) -> None:
        assert self._child is not None
        self._child.send(line + "\r")

    def signal(self, number: int) -> None:
        assert self._child is not None
        os.kill(self._child.pid, number)

    def wait_for_end(self) -> str:
        """Wait for the end; returns all that was shown."""
        assert self.question() is None, self.shown[-800:]
        return self.shown

    @property
    def code(self) -> int | None:
        assert self._child is not None
        return self._child.exitstatus


def last_pose(shown: str) -> Array:
    """Return the last displayed pose (n,), rad."""
    line = next(part for part in reversed(shown.splitlines()) if "J1 " in part)
    return np.radians([float(v) for v in JOINT.findall(line)])
