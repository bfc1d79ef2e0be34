"""How late this machine wakes what waits: measured beside the tests in real time."""

from __future__ import annotations

import contextlib
import mmap
import os
import struct
import subprocess
import sys
import time

EVERY = 0.005  # s between two looks
NOTED = 0.010  # s: what is later is noted
LIMIT = 0.040  # s: what a state may be old (docs/reliability.md); what a test bears that names none
STARVED = 0.5  # share of a test's time for which one of its threads wanted a core and had none
CASES: list[str] = []  # the tests in real time that were collected
PROBE = 0.3  # s that the machine is watched before a test
_WATCH = f"""
import mmap, os, select, signal, struct, sys, time, tty
parent = os.getppid()
cores = sorted(os.sched_getaffinity(0))
shared = mmap.mmap(int(sys.argv[1]), 8 * (len(cores) + 1))
slot, first = 0, os.getpid()
for k in range(1, len(cores) + 1):
    if os.fork() == 0:
        parent, slot = first, k  # ends, too, where the first has ended by now
        break
def ended(*_):
    if os.waitpid(-1, os.WNOHANG)[0]:  # not one that is only stopped
        os._exit(1)
if slot == 0:
    signal.signal(signal.SIGCHLD, ended)
terminal = None
if slot == len(cores):
    terminal = os.openpty()
    tty.setraw(terminal[1])
else:
    try:
        os.sched_setaffinity(0, cores[slot : slot + 1])
    except OSError:
        pass
os.set_blocking(1, False)
due = time.time() + {EVERY}
struct.pack_into("d", shared, 8 * slot, due)
try:
    os.write(1, b"\\n")
    while os.getppid() == parent:
        time.sleep({EVERY})
        if terminal:
            os.write(terminal[0], b"x")
            select.select(terminal[1:], [], [])
            os.read(terminal[1], 1)
        now = time.time()
        if now - due > {NOTED}:
            try:
                os.write(1, b"%r %r\\n" % (due, now - due))
            except BlockingIOError:
                pass
        due = now + {EVERY}
        struct.pack_into("d", shared, 8 * slot, due)
except BrokenPipeError:
    pass
os._exit(0)
"""


def core_waits() -> dict[str, float]:
    """Return how long each thread of this process has waited for a core while it could run, s.

    Source: proc(5), /proc/PID/schedstat, second figure. A thread that sleeps waits for none.
    """
    found = {}
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(OSError), open(f"/proc/self/task/{thread}/schedstat") as file:
            found[thread] = 1e-9 * int(file.read().split()[1])
    return found


def longest_wait(since: dict[str, float]) -> float:
    """Return how long the thread that waited longest for a core since then has done so, s."""
    return max(waited - since.get(thread, 0.0) for thread, waited in core_waits().items())


class Witness:
    """Processes that only sleep, one on each core, and note when they were woken late.

    A host may stop one of a virtual machine's cores while the others run: what slept on another
    would not notice. One more hands bytes to itself over a pseudo-terminal, which a thread of the
    kernel carries: on a busy machine it waits for a core, too, while no process is woken late. They
    are as important as this process. When each is due stands in memory that
    is shared: one that has not been woken yet is as late as it is overdue.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._due: mmap.mmap | None = None  # one double a watcher, s since 1970
        self._rest = b""
        self._late: list[tuple[float, float]] = []  # s since 1970: due; s: how late

    def start(self) -> None:
        """Begin to watch, and return when each core is watched; may be repeated."""
        if self._process is not None:
            return
        watchers = len(os.sched_getaffinity(0)) + 1
        shared = os.memfd_create("lateness")
        try:
            os.ftruncate(shared, 8 * watchers)
            self._due = mmap.mmap(shared, 8 * watchers)
            command = [sys.executable, "-S", "-E", "-c", _WATCH, str(shared)]
            self._process = subprocess.Popen(command, stdout=subprocess.PIPE, pass_fds=[shared])
        finally:
            os.close(shared)
        assert self._process.stdout is not None
        while not all(due for (due,) in struct.iter_unpack("d", self._due)):
            data = os.read(self._process.stdout.fileno(), 65536)  # each writes once it is due
            assert data, "a watcher has ended"
            self._take(data)
        os.set_blocking(self._process.stdout.fileno(), False)

    def worst(self, since: float, until: float) -> float:
        """Return how late it was woken at worst between two moments (s since 1970), s."""
        overdue = self._overdue()  # before what they noted: they note first, then are due anew
        self._read()
        looks = [*self._late, *overdue]
        return max((late for due, late in looks if due < until and due + late > since), default=0.0)

    def probe(self) -> float:
        """Watch for a moment; return how late it was woken at worst, s."""
        begun = time.time()
        time.sleep(PROBE)
        late = time.time() - begun - PROBE  # this process is a witness too
        return max(late, self.worst(begun, time.time()))

    def _overdue(self) -> list[tuple[float, float]]:
        """Return when those are due that should have been woken, and how late they are, s.

        Where one has ended all have, and excuse nothing: it is not the machine that is late.
        """
        if self._due is None or self._process is None or self._process.poll() is not None:
            return []
        now = time.time()
        waiting = [(due, now - due) for (due,) in struct.iter_unpack("d", self._due)]
        return [(due, late) for due, late in waiting if late > NOTED]

    def _read(self) -> None:
        if self._process is None or self._process.stdout is None:
            return
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self._process.stdout.fileno(), 65536):
                self._take(data)

    def _take(self, data: bytes) -> None:
        """Keep what the watchers wrote: an empty line when one begins, then when each was late."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            with contextlib.suppress(ValueError):  # an attacker writes into every pipe it finds
                due, late = map(float, line.split())
                self._late.append((due, late))
        del self._late[:-10_000]

    def stop(self) -> None:
        """End it."""
        process, self._process, self._due = self._process, None, None
        if process is not None:
            process.kill()
            process.wait()
            assert process.stdout is not None
            process.stdout.close()
