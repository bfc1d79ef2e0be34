"""New cells, one an arm, with the flexibilities that the fleet's fit has found."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import numpy as np

from gapbridge.bridge.cell import load_cell, save_cell
from gapbridge.bridge.document.output_file import write_text
from gapbridge.bridge.fleet.fit_summary import Fitted, FittedArm, FittedType
from gapbridge.core.estimation.compliance_fit import flexibilities

TABLE = "cells.csv"


def write_cells(found: Fitted, folder: Path) -> list[Path]:
    """Write a cell per arm and the table that names them; returns the paths, the table last.

    Each is the cell of the arm's last session; what the fleet does not show stays as it is there.
    """
    written: list[tuple[str, Path]] = []
    taken: set[str] = set()
    for kind in found.types:
        for arm in kind.arms:
            path = folder / f"{_file_name(arm.name, taken)}.yaml"
            _write(kind, arm, path)
            written.append((arm.name, path))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("arm", "cell"))
    table.writerows((arm, path.name) for arm, path in written)
    write_text(folder / TABLE, text.getvalue())
    return [*(path for _, path in written), folder / TABLE]


def _write(kind: FittedType, arm: FittedArm, path: Path) -> None:
    cell = load_cell(Path(arm.sessions[-1].outcome.cell))
    values = np.where(kind.scatter.shown, arm.fit.flexibility, flexibilities(cell.model))
    n = cell.arm.n
    save_cell(cell, path, cell.model.with_compliance(values[:n], values[n:]))


def _file_name(arm: str, taken: set[str]) -> str:
    """Return a file name for an arm, none twice."""
    plain = re.sub(r"[^\w.-]+", "_", arm).strip(".") or "arm"
    name, count = plain, 1
    while name.lower() in taken:
        count += 1
        name = f"{plain}-{count}"
    taken.add(name.lower())
    return name
