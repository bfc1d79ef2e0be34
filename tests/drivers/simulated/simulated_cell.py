"""A simulated cell for tests: an address of its own, a bench, clients in processes of their own."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import textwrap
from typing import Any

from patience import PATIENCE
from ports import own_host

from gapbridge.drivers.simulated.ur.settings import BENCH_PORT, ServerSettings, simulated_cell


def cell_settings(seed: int = 7, arm: str = "ur10e", **plant: Any) -> ServerSettings:
    return simulated_cell(arm, own_host(), seed, **plant)


class Bench:
    """The bench's line protocol."""

    def __init__(self, host: str) -> None:
        self._socket = socket.create_connection((host, BENCH_PORT), timeout=5)
        self._lines = self._socket.makefile("r")

    def ask(self, line: str) -> str:
        self._socket.sendall(line.encode() + b"\n")
        return self._lines.readline().strip()

    def do(self, line: str) -> None:
        assert self.ask(line) == "ok"

    def truth(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.ask("truth"))
        return found

    def measure(self) -> list[float]:
        return [float(v) for v in self.ask("measure").split(",")]

    def close(self) -> None:
        self._lines.close()
        self._socket.close()


def run_client(host: str, body: str, timeout: float = 2 * PATIENCE) -> dict[str, Any]:
    """Run ur_rtde code in a process of its own; returns what it puts into `out`.

    The library can hang, abort or crash its process, so it never shares one with a test.
    `until(ready)` is for what comes a while after a command; it waits for PATIENCE at most.
    """
    code = (
        "import json, os, sys, time, math\n"
        f"host = {host!r}\nout = {{}}\n"
        "def until(ready):\n"
        f"    end = time.monotonic() + {PATIENCE}\n"
        "    while not ready() and time.monotonic() < end:\n"
        "        time.sleep(0.01)\n"
        + textwrap.dedent(body)
        + "\nsys.stdout.write('\\n' + json.dumps(out) + '\\n')\nsys.stdout.flush()\nos._exit(0)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=timeout, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found
