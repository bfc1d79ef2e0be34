"""A simulated cell that the daemon runs on: its controller, its bench, its cell file."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import textwrap
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from patience import PATIENCE, wait_for
from ports import own_host
from simulated_controller import SimulatedController

from benchmarks.server_thread import OFFSET_SCRIPT
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.run_settings import settings_of
from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.daemon.summary import RunSummary
from gapbridge.bridge.ipc.control_client import ask
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.core.errors import RunError
from gapbridge.core.log.mcap_reading import read_columns
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.simulated.ur.settings import BENCH_PORT, ServerSettings, simulated_cell

Array = NDArray[np.float64]
TCP = (0.0, 0.0, 0.18, 0.0, 0.0, 0.0)
PAYLOAD, COG = 5.0, (0.0, 0.0, 0.06)


def plant(**changed: Any) -> ServerSettings:
    given: dict[str, Any] = {"tcp": TCP, "payload_mass": PAYLOAD, "payload_cog": COG}
    return simulated_cell("ur10e", own_host(), 11, **{**given, **changed})


class Robot:
    """A simulated controller with its bench, and a cell file that knows its true compliance."""

    def __init__(self, folder: Path, settings: ServerSettings | None = None) -> None:
        self.settings = settings or plant()
        self.host = self.settings.host
        self.folder = folder
        self.controller = SimulatedController(self.settings, log_level="INFO")

    def __enter__(self) -> Self:
        self.controller.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.controller.stop()

    def bench(self, line: str) -> str:
        with socket.create_connection((self.host, BENCH_PORT), timeout=PATIENCE) as link:
            link.sendall(line.encode() + b"\n")
            return link.makefile("r").readline().strip()

    def truth(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.bench("truth"))
        return found

    def clock(self) -> float:
        """Return the controller's own time, s."""
        return float(self.bench("measure").split(",")[0])

    def elapse(self, seconds: float) -> None:
        """Wait until the controller has run for so long by its own clock."""
        until = self.clock() + seconds
        wait_for(lambda: self.clock() >= until, f"{seconds:g} s of the controller")

    def tcp(self, readings: int = 20) -> Array:
        """Return the true TCP's position (3,) as the tracker sees it, m."""
        rows = [self.bench("measure").split(",") for _ in range(readings)]
        return np.array(rows, dtype=float).mean(axis=0)[1:4]

    def start_offset_program(self) -> socket.socket:
        """Start the program of the offset mode; it runs until the socket is closed."""
        upload = socket.create_connection((self.host, self.settings.script_port), timeout=PATIENCE)
        self.upload(upload, OFFSET_SCRIPT.read_text(encoding="utf-8"))
        return upload

    def upload(self, link: socket.socket, program: str) -> None:
        """Send a program, and wait until it has begun."""
        before = self.controller.log().count(" starts\n")
        link.sendall(program.encode())
        wait_for(lambda: self.controller.log().count(" starts\n") > before, "the program")

    def cell(self, link: str = "", **sections: str) -> Path:
        """Write the cell file; ``link`` adds to its link, the others are whole sections."""
        axial, radial = list(self.settings.plant.axial), list(self.settings.plant.radial)
        text = textwrap.dedent(f"""\
            robot: {{model: ur10e}}
            tool: {{tcp: {{xyz: [0, 0, 0.18], rpy: [0, 0, 0]}}}}
            payload: {{mass: {PAYLOAD}, cog: [0, 0, 0.06]}}
            compliance: {{axial: {axial}, radial: {radial}}}
            link: {{driver: ur_rtde, host: {self.host}{link}}}
            recording: {{folder: recordings}}
            """)
        for name, body in sections.items():
            text += f"{name}: {body}\n"
        path = self.folder / "cell.yaml"
        path.write_text(text, encoding="utf-8")
        return path


LATE = ("old as they come", "clock has stopped", "a gap of", "a fault is latched", "found state")
"""What requests are refused for where a busy machine has made states late."""


def ask_again(cell: Path, command: str) -> str:
    """Return the answer to ``arm`` or ``disarm`` as a person asks: again where states were late."""

    def answered() -> str:
        try:
            return str(ask(cell, command))
        except RunError as error:
            if not any(words in str(error) for words in LATE):
                raise
        with suppress(RunError):
            ask(cell, "disarm")
        return ""

    return str(wait_for(answered, f"an answer to {command}"))


class Run:
    """A daemon in a thread of the test; its loop is a process as always."""

    def __init__(self, cell: Path, arm: bool = False, observe: bool = False,
                 duration: float | None = None, hang_timeout: float = 10.0) -> None:  # fmt: skip
        self.output: list[str] = []  # 1 s would end loops that a busy machine suspends
        settings = settings_of(load_cell(cell)).model_copy(update={"hang_timeout": hang_timeout})
        self.daemon = Daemon(settings, may_write=not observe, say=self.output.append, clock=SYSTEM)
        self.summary: RunSummary | None = None
        self.error: Exception | None = None
        self._thread = threading.Thread(target=self._run, args=(arm, duration))

    def _run(self, arm: bool, duration: float | None) -> None:
        try:
            self.summary = self.daemon.run(arm, duration)
        except Exception as error:
            self.error = error

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.daemon.stop()
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()

    def wait(self, state: State) -> None:
        """Wait until the loop is in a state."""

        def there() -> bool:
            assert self.error is None, self.error
            return self.daemon.state == state

        wait_for(there, lambda: f"{state.name} ({self.output})")

    def compensate(self) -> None:
        """Arm, again as a person does where a busy machine ended the motion at once."""
        until, asked = time.monotonic() + PATIENCE, 0.0
        while self.daemon.state != State.COMPENSATING:
            now = time.monotonic()
            assert self.error is None, self.error
            assert now < until, f"{self.daemon.state} ({self.output}): not within {PATIENCE:g} s"
            late = any(words in self.daemon.latched for words in LATE)
            if now - asked > 3.0 and (self.daemon.state == State.OBSERVING or late):
                (self.daemon.disarm if late else self.daemon.arm)()
                asked = now
            time.sleep(0.002)

    def write(self, count: int) -> None:
        """Compensate until so many more setpoints have been written."""
        before = self._written

        def there() -> bool:
            self.compensate()
            return self._written >= before + count

        wait_for(there, lambda: f"{count} setpoints ({self.output})")

    def cycle(self, count: int) -> None:
        """Wait until the loop has run so many more cycles, writing or not."""
        memory = self.daemon.memory
        until = memory.written + count

        def there() -> bool:
            assert self.error is None, self.error
            return memory.written >= until

        wait_for(there, lambda: f"{count} cycles ({self.output})")

    def latest(self, column: str) -> Array:
        """Return a column's values in the newest cycle."""
        memory = self.daemon.memory
        rows, _ = memory.rows(max(memory.written - 1, 0), memory.written)
        return np.array(rows[-1][memory.slices[column]])

    @property
    def _written(self) -> int:
        return int(self.daemon.status()["link"]["written"])

    def end(self) -> RunSummary:
        """Stop the run and return how it went."""
        self.daemon.stop()
        return self.join()

    def join(self) -> RunSummary:
        """Wait for the run's own end."""
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive(), self.output
        assert self.error is None, self.error
        assert self.summary is not None
        return self.summary

    def cycles(self) -> dict[str, Any]:
        """Return the recorded columns: arrays, and the states as words."""
        return read_recording(self.daemon)


def read_recording(daemon: Daemon) -> dict[str, Any]:
    path = daemon.recording
    assert path is not None
    return read_cycles(path)


def read_cycles(path: Path) -> dict[str, Any]:
    """Return a recording's cycles: one array per column of the log, and the states as words."""
    found: dict[str, Any] = {}
    for name, values in read_columns(path).items():
        if values.ndim == 1:
            found[name] = values
        else:
            found.update({f"{name}_{i}": values[:, i] for i in range(values.shape[1])})
    found["state"] = [State(int(state)).name.lower() for state in found["state"]]
    return found


def only_recording(folder: Path) -> Path:
    """Return the one run that is recorded in a folder."""
    (session,) = {path.name.rsplit("-", 1)[0] for path in folder.glob("run-*.mcap")}
    return folder / session


def offsets(cycles: dict[str, Any]) -> Array:
    """Return the TCP offsets (N, 6) that the arm had; zero where nothing was to be written.

    A cycle whose setpoint could not leave (its state was too old) keeps the offset before it.
    """
    found = np.stack([cycles[f"offset_{i}"] for i in range(6)], axis=1)
    wrote, meant = cycles["written"] > 0, cycles["attempted"] > 0
    last = np.maximum.accumulate(np.where(wrote | ~meant, np.arange(len(found)), 0))
    return np.where(wrote[last, None], found[last], 0.0)


def gapbridge(*arguments: object, folder: Path) -> subprocess.Popen[str]:
    """Start the command line in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    return subprocess.Popen(
        [sys.executable, "-m", "gapbridge", *map(str, arguments)],
        cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
