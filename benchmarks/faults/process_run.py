"""A daemon in a process of its own, which may be ended and killed; its events come as lines."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil

from benchmarks.faults.punctual import go_first
from benchmarks.faults.running import Event, SourceStatus
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import NAME, SharedMemory
from gapbridge.drivers.clock import SYSTEM

CODE = """
import ctypes, json, signal, sys
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cli import main
from gapbridge.bridge.daemon.run import run_cell
def emit(event):
    print(json.dumps(event, default=str), file=sys.stderr, flush=True)
sys.exit(run_cell(load_cell(sys.argv[1]), arm=True, log=emit))
"""
PAGE_LIMIT = 90.0  # s
LOOK_EVERY = 0.02  # s between two looks for the memory of a new loop
END_LIMIT = 6.0  # s for every process of a run to be gone


class ProcessRun(SourceStatus):
    """``gapbridge run CELL --arm`` as the command runs it."""

    def __init__(self, cell: Path) -> None:
        self._cell, self._n = cell, load_cell(cell).arm.n
        self.events: list[Event] = []
        self.error: BaseException | None = None
        self.output = ""
        self._memory: SharedMemory | None = None
        self._looked = 0.0  # s, monotonic: when the newest memory was last looked for
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start it and read along."""
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        self._process = subprocess.Popen(
            [sys.executable, "-c", CODE, str(self._cell)], env=environment, text=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, cwd=self._cell.parent,
            start_new_session=True,
        )  # fmt: skip
        go_first(self.pid)
        threading.Thread(target=self._listen, daemon=True).start()
        self._memory = self._join(time.monotonic() + PAGE_LIMIT)

    def _listen(self) -> None:
        assert self._process is not None and self._process.stderr is not None
        for line in self._process.stderr:
            try:
                self.events.append(json.loads(line))
            except ValueError:
                self.output += line

    def _join(self, until: float) -> SharedMemory:
        """Return the newest memory of the daemon; raises TimeoutError where there is none."""
        while time.monotonic() < until:
            found = self._newest()
            if found is not None:
                return SharedMemory(self._n, found, writable=False, clock=SYSTEM)
            if not self.alive:
                break
            time.sleep(0.02)
        raise TimeoutError(f"the daemon did not start: {self.output[-300:]}")

    def _newest(self) -> int | None:
        """Return a descriptor of the memory of the newest loop: it is numbered as it is made."""
        folder, found = Path(f"/proc/{self.pid}/fd"), dict[int, str]()
        with contextlib.suppress(OSError):
            for name in os.listdir(folder):
                if os.readlink(folder / name).startswith(f"/memfd:{NAME}"):
                    found[os.stat(folder / name).st_ino] = name
            if found and (self._memory is None or max(found) != os.fstat(self._memory.fd).st_ino):
                return os.open(folder / found[max(found)], os.O_RDONLY)
        return None

    @property
    def memory(self) -> SharedMemory:
        """Return the shared memory of the run's newest loop."""
        assert self._memory is not None
        now = time.monotonic()
        if now - self._looked > LOOK_EVERY:
            self._looked = now
            if (fd := self._newest()) is not None:
                self._memory = SharedMemory(self._n, fd, writable=False, clock=SYSTEM)
        return self._memory

    @property
    def pid(self) -> int:
        """Return the daemon's process id."""
        assert self._process is not None
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Return whether the daemon itself runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def exit_code(self) -> int | None:
        """Return how it ended."""
        return None if self._process is None else self._process.poll()

    @property
    def state(self) -> State:
        """Return the loop's state at this moment."""
        return State(max(self.state_word(), 0))

    def state_word(self) -> int:
        """Return the supervisor's state from the shared memory, -1 where there is none yet."""
        return -1 if self._memory is None else self.memory.state

    def processes(self) -> dict[str, psutil.Process]:
        """Return the processes of the run by the module that they run, ``daemon`` itself too."""
        found = {"daemon": psutil.Process(self.pid)}
        for child in found["daemon"].children(recursive=True):
            with contextlib.suppress(psutil.Error):
                arguments = child.cmdline()
                name = arguments[arguments.index("-m") + 1] if "-m" in arguments else "other"
                found[name.removeprefix("bridge.").removesuffix(".main")] = child
        return found

    def send(self, number: signal.Signals) -> dict[str, psutil.Process]:
        """Send the daemon a signal; returns the processes that its run had."""
        found = self.processes()
        os.kill(self.pid, number)
        return found

    def stop(self) -> None:
        """End it, by force where it does not end by itself."""
        if not self.alive:
            return
        found = self.send(signal.SIGTERM)
        _, left = psutil.wait_procs(found.values(), END_LIMIT)
        for process in left:
            with contextlib.suppress(psutil.Error):
                process.kill()
