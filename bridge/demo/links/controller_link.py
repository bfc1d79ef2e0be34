"""What links without a UR controller share: ``gapbridge simulate`` serves the arm."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np

from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.bridge.demo.bench import Bench
from gapbridge.bridge.demo.links.link import DemoLink
from gapbridge.bridge.demo.poses import Load
from gapbridge.bridge.demo.served_cell import ServedCell
from gapbridge.bridge.document.output_file import write_text
from gapbridge.core.arrays import Array
from gapbridge.core.errors import CellError
from gapbridge.drivers.simulated.ur.settings import BENCH_PORT

PAYLOAD = re.compile(r"^payload:.*$", re.MULTILINE)


class ControllerLink(DemoLink):
    """An arm whose controller is not informed of its payload: the cell file says it."""

    @property
    def home(self) -> Array:
        """Return where the arm stands at the start (n,), rad."""
        return np.array(self.cell.simulation.start_q)

    def served(self) -> AbstractContextManager[object]:
        """Serve the simulated controller in a process of its own. Raises LinkError."""
        return self._serving()

    @contextmanager
    def _serving(self) -> Iterator[None]:
        """Serve a copy of the cell that lies elsewhere: what is hidden in it stays hidden."""
        with tempfile.TemporaryDirectory(prefix="simulated-") as folder:
            hidden = Path(folder) / "cell.yaml"
            text = self.cell.path.read_text(encoding="utf-8") + self._hidden()
            for key, values in self.hidden.simulation.items():
                text += f"  {key}: [{', '.join(f'{v:.9e}' for v in values)}]\n"
            write_text(hidden, text)
            for name in self.files:
                write_text(Path(folder) / name, (self.cell.path.parent / name).read_text("utf-8"))
            with ServedCell(hidden, self.seed):
                yield

    def _hidden(self) -> str:
        """Return lines of section ``simulation`` that only the simulated arm may know."""
        return ""

    def bench(self) -> Bench:
        """Return a connection to the bench."""
        return Bench(self.host, BENCH_PORT)

    def declared(self, cell: Cell, load: Load) -> Cell:
        """Return the cell with this load as its payload, as its user would write it."""
        cog = ", ".join(f"{v:g}" for v in load.cog)
        text = cell.path.read_text(encoding="utf-8")
        declared, count = PAYLOAD.subn(f"payload: {{mass: {load.mass:g}, cog: [{cog}]}}", text)
        if count != 1:
            raise CellError(f"{cell.path}: payload: found {count} lines, expected one")
        path = cell.path.with_name(f"{cell.path.stem}-{load.name.replace(' ', '-')}.yaml")
        write_text(path, declared)
        return load_cell(path)
