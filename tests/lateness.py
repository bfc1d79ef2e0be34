"""How late this machine wakes a process that waits: measured beside the tests in real time."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time

EVERY = 0.005  # s between two looks
NOTED = 0.010  # s: what is later is noted
LIMIT = 0.040  # s: what a state may be old (docs/reliability.md); a machine so late judges nothing
PROBE = 0.1  # s that it is watched before a test
HOPELESS = 0.2  # s: so late within the probe, a test need not begin
_WATCH = f"""
import os, sys, time
parent = os.getppid()
cores = sorted(os.sched_getaffinity(0))
for core in cores[1:]:
    if os.fork() == 0:
        cores[0], parent = core, os.getppid()
        break
try:
    os.sched_setaffinity(0, cores[:1])
except OSError:
    pass
while os.getppid() == parent:
    due = time.time() + {EVERY}
    time.sleep({EVERY})
    late = time.time() - due
    if late > {NOTED}:
        os.write(1, b"%r %r\\n" % (due, late))
"""


class Witness:
    """Processes that only sleep, one on each core, and note when they were woken late.

    A host may stop one of a virtual machine's cores while the others run: what slept on another
    would not notice. They are as important as this process.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._rest = b""
        self._late: list[tuple[float, float]] = []  # s since 1970: due; s: how late

    def start(self) -> None:
        """Begin to watch; may be repeated."""
        if self._process is not None:
            return
        self._process = subprocess.Popen(
            [sys.executable, "-S", "-E", "-c", _WATCH], stdout=subprocess.PIPE
        )
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)

    def worst(self, since: float, until: float) -> float:
        """Return how late it was woken at worst between two moments (s since 1970), s."""
        self._read()
        found = [late for due, late in self._late if due < until and due + late > since]
        return max(found, default=0.0)

    def probe(self) -> float:
        """Watch for a moment; return how late it was woken at worst, s."""
        begun = time.time()
        time.sleep(PROBE)
        late = time.time() - begun - PROBE  # this process is a witness too
        return max(late, self.worst(begun, time.time()))

    def _read(self) -> None:
        if self._process is None or self._process.stdout is None:
            return
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self._process.stdout.fileno(), 65536):
                self._rest += data
        *lines, self._rest = self._rest.split(b"\n")
        for line in lines:
            with contextlib.suppress(ValueError):  # an attacker writes into every pipe it finds
                due, late = map(float, line.split())
                self._late.append((due, late))
        del self._late[:-10_000]

    def stop(self) -> None:
        """End it."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            assert process.stdout is not None
            process.stdout.close()
