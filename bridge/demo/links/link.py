"""What differs from link to link in the demo; everything else is in job.py."""

from __future__ import annotations

import os
import re
import socket
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib import resources
from pathlib import Path
from typing import ClassVar

import numpy as np

from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.demo.bench import Bench
from gapbridge.bridge.demo.hidden import HiddenEffects
from gapbridge.bridge.demo.measurements import SETTLING_TIME
from gapbridge.bridge.demo.poses import Experiment, Load
from gapbridge.bridge.demo.processes import ServedCell
from gapbridge.bridge.demo.result import Resolution
from gapbridge.bridge.document.output_file import write_text
from gapbridge.core.arrays import Array
from gapbridge.core.errors import RunError
from gapbridge.drivers.simulated.ur.settings import BENCH_PORT

PAYLOAD = re.compile(r"^payload:.*$", re.MULTILINE)
LAST_HOST = 60  # addresses 127.0.0.2 to 127.0.0.60 are tried


class DemoLink(ABC):
    """The demo on one link: arm, simulated controller, motion, and what the link reports."""

    name: ClassVar[str]
    template: ClassVar[str]  # the cell file, in bridge/demo
    files: ClassVar[tuple[str, ...]] = ()  # files that the cell refers to, also there
    ports: ClassVar[tuple[int, ...]]  # of the simulated controller
    experiment: ClassVar[Experiment]
    settling: ClassVar[float] = SETTLING_TIME  # s at rest before readings count
    effect_choices: ClassVar[tuple[str, ...]] = ("bent_tool",)  # one is drawn from the seed
    reports_joints: ClassVar[bool] = True  # measured joints are fine enough for the fit

    def __init__(self, out: Path, seed: int) -> None:
        self.seed = seed
        self.hidden = HiddenEffects.drawn(seed, self.effect_choices)  # besides the flexibilities
        self.host = free_address(self.ports)
        self.cell = self._write_cell(out)

    def _write_cell(self, out: Path) -> Cell:
        """Write the demo's cell and the files that it refers to into ``out``."""
        package = resources.files("gapbridge.bridge.demo")
        for name in (self.template, *self.files):
            text = package.joinpath(name).read_text(encoding="utf-8")
            path = out / ("cell.yaml" if name == self.template else name)
            write_text(path, text.replace("HOST", self.host) if name == self.template else text)
        return load_cell(out / "cell.yaml")

    @property
    def home(self) -> Array:
        """Return the arm's start pose (n,), rad."""
        return np.array(self.cell.file.simulation.start_q)

    @contextmanager
    def served(self) -> Iterator[None]:
        """Serve the simulated controller in a child process. Raises LinkError.

        Its cell is a copy in another folder that also has the hidden effects.
        """
        with tempfile.TemporaryDirectory(prefix="simulated-") as folder:
            simulated = Path(folder) / "cell.yaml"
            text = self.cell.path.read_text(encoding="utf-8") + self._simulation_lines()
            for key, values in self.hidden.simulation.items():
                text += f"  {key}: [{', '.join(f'{v:.9e}' for v in values)}]\n"
            write_text(simulated, text)
            for name in self.files:
                write_text(Path(folder) / name, (self.cell.path.parent / name).read_text("utf-8"))
            with ServedCell(simulated, self.seed):
                yield

    def _simulation_lines(self) -> str:
        """Return further lines of the section ``simulation`` of the simulated controller's cell."""
        return ""

    def bench(self) -> Bench:
        """Return a connection to the bench port."""
        return Bench(self.host, BENCH_PORT)

    @abstractmethod
    def resolution(self) -> Resolution:
        """Return the resolution of written and read values at the TCP."""

    def declared(self, cell: Cell, load: Load) -> Cell:
        """Return the cell of a run with this load declared as its payload; writes its file."""
        cog = ", ".join(f"{v:g}" for v in load.cog)
        text = cell.path.read_text(encoding="utf-8")
        declared, count = PAYLOAD.subn(f"payload: {{mass: {load.mass:g}, cog: [{cog}]}}", text)
        if count != 1:
            raise cell.error(("payload",), f"found {count} lines, expected one")
        path = cell.path.with_name(f"{cell.path.stem}-{load.name.replace(' ', '-')}.yaml")
        write_text(path, declared)
        return load_cell(path)

    @abstractmethod
    def prepare(self, folder: Path, poses: Array) -> float:
        """Prepare a motion from home through ``poses`` (M, n) and home; returns its duration, s."""

    def motion(self, daemon: Daemon, poses: Array) -> AbstractContextManager[object]:
        """Move the arm during a run where setpoints do not. Raises LinkError when it ends."""
        return nullcontext()


def free_address(ports: tuple[int, ...]) -> str:
    """Return a loopback address on which all ``ports`` are free. Raises RunError."""
    count = LAST_HOST - 1
    for k in range(count):  # a different start per process: two may search at once
        host = f"127.0.0.{2 + (os.getpid() + k) % count}"
        if all(_is_free(host, port) for port in ports):
            return host
    raise RunError(f"found every address from 127.0.0.2 to 127.0.0.{LAST_HOST} taken")


def _is_free(host: str, port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
    return True
