"""A cell's simulated controller in a process of its own (``gapbridge simulate``) or a thread."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.links.case import Cycles, LinkCase, Pause
from benchmarks.server_thread import ServerThread
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.cell import Cell
from gapbridge.bridge.cell.simulation import served_controller

ARM = """\
robot: {model: ur10e}
payload: {mass: 5.0, cog: [0.0, 0.0, 0.06]}
compliance: {axial: [3.0e-6, 4.0e-6, 5.0e-6, 9.0e-6, 1.2e-5, 1.5e-5]}
"""
"""The same arm on every link: what compensation costs is not what differs."""


@contextmanager
def written(link: str) -> Iterator[Path]:
    """Yield the path of a cell with this link section."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        path.write_text(ARM + link, encoding="utf-8")
        yield path


@contextmanager
def served_cell(link: str) -> Iterator[Cell]:
    """Serve a cell in another process while the block lasts; yields it loaded."""
    with written(link) as path:
        process = subprocess.Popen(
            [sys.executable, "-m", "gapbridge", "simulate", str(path)],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            assert process.stdout is not None
            while not process.stdout.readline().startswith("ready"):
                if process.poll() is not None:
                    raise SystemExit("the simulated controller did not start")
            yield load_cell(path)
        finally:
            process.terminate()
            process.wait(5.0)


@contextmanager
def thread_served_cell(link: str) -> Iterator[Cell]:
    """Serve a cell in a thread of this process while the block lasts; yields it loaded."""
    with written(link) as path:
        cell = load_cell(path)
        assert cell.link is not None
        found = served_controller(cell, cell.link)
        with ServerThread(found.controller, found.servers, found.host):
            yield cell


Armed = Callable[[Cell, Pause], AbstractContextManager[Cycles]]


@dataclass(frozen=True)
class HubCase(LinkCase):
    """A CAN bus between processes, over the socketcand protocol."""

    name: str
    library: str
    link: str  # section of the cell
    armed: Armed

    @contextmanager
    def served(self, pause: Pause) -> Iterator[Cycles]:
        """Yield the two sides."""
        with served_cell(self.link) as cell, self.armed(cell, pause) as cycles:
            yield cycles


class VirtualCase(HubCase):
    """In one process, over python-can's virtual bus; what is simulated is a thread beside."""

    @contextmanager
    def served(self, pause: Pause) -> Iterator[Cycles]:
        """Yield the two sides, which sleep in between: spinning starves a thread beside."""
        with thread_served_cell(self.link) as cell, self.armed(cell, time.sleep) as cycles:
            yield cycles
