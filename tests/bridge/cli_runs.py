"""How tests run the command line, and the logs that they run it on."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.cli import main
from gapbridge.core.arm import builtin_arm
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

Array = NDArray[np.float64]
CELL = """\
# my cell
robot: {model: ur10e}
metrology: {registered: true, sigma: 2.0e-5}
"""
AXIAL = (3e-6, 8e-6, 7e-6, 1e-5, 1.2e-5, 2e-5)  # rad/Nm
RADIAL = (1e-6, 1e-6, 2e-6, 2e-6, 3e-6, 3e-6)


@dataclass(frozen=True)
class Answer:
    code: int
    out: str
    err: str


def gapbridge(*arguments: object) -> Answer:
    """Run the command line in this process, as the installed entry point does."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(a) for a in arguments])
        except SystemExit as leaving:
            code = leaving.code
    assert isinstance(code, int)
    return Answer(code, out.getvalue(), err.getvalue())


def refused(*arguments: object) -> str:
    """Return the one line that unusable input is refused with."""
    answer = gapbridge(*arguments)
    assert answer.code == 2, answer
    assert answer.err.endswith("\n")
    assert answer.err.count("\n") == 1, answer.err
    assert "Traceback" not in answer.err
    return answer.err


def cell_in(folder: Path, text: str = CELL) -> Path:
    path = folder / "cell.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def bent_model() -> Model:
    return Model(builtin_arm("ur10e")).with_compliance(AXIAL, RADIAL)


def poses_and_loads(rows: int, seed: int = 0) -> tuple[Array, Loads]:
    """Return poses (rows, 6), rad, under payloads and pulls."""
    rng = np.random.default_rng(seed)
    q = np.array([0.0, -1.2, 1.5, -1.8, -1.5, 0.0]) + rng.uniform(-0.9, 0.9, (rows, 6))
    pull = np.hstack([rng.uniform(-60, 60, (rows, 3)), rng.uniform(-8, 8, (rows, 3))])
    cog = np.tile([0.0, 0.02, 0.1], (rows, 1))
    return q, Loads(payload_mass=rng.choice([0.0, 5.0, 10.0], rows), payload_cog=cog, wrench=pull)


def columns_of(q: Array, loads: Loads) -> dict[str, Array]:
    """Return poses and loads as columns of a log."""
    table: dict[str, Array] = {f"actual_q_{i}": q[:, i] for i in range(q.shape[1])}
    assert loads.payload_mass is not None
    assert loads.payload_cog is not None
    assert loads.wrench is not None
    table["payload"] = loads.payload_mass
    table |= {f"payload_cog_{i}": loads.payload_cog[:, i] for i in range(3)}
    return table | {f"actual_TCP_force_{i}": loads.wrench[:, i] for i in range(6)}


def measured(model: Model, q: Array, loads: Loads, noise: float = 0.0) -> dict[str, Array]:
    """Return what an instrument in base would measure, as columns of a log."""
    position = model.predict(q, loads).position
    position = position + np.random.default_rng(1).normal(0, 1, position.shape) * noise
    return {f"measured_position_{i}": position[:, i] for i in range(3)}


def log_in(folder: Path, columns: dict[str, Array], name: str = "log.csv") -> Path:
    path = folder / name
    text = [",".join(columns)]
    table = np.column_stack(list(columns.values()))
    text += [",".join(f"{v:.17g}" for v in row) for row in table]
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    return path


def table_of(path: Path) -> tuple[list[str], Array]:
    """Return the column names and the rows of a written CSV."""
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = [[float(v) for v in line.split(",")] for line in lines[1:]]
    return lines[0].split(","), np.array(rows)


def names(stem: str, count: int) -> Sequence[str]:
    return [f"{stem}_{i}" for i in range(count)]
