"""A model whose correction is no number as soon as a file stands beside the cell.

Named as ``model_source`` of a run; only the loop's process is changed by it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell import load_cell as load
from gapbridge.core.compensation import Compensator, Correction
from gapbridge.core.loads import Loads

FLAG = "no_number"


def load_cell(path: Path) -> Cell:
    """Return a cell, and have corrections ruined once the file ``no_number`` is beside it."""
    flag, correct = path.parent / FLAG, Compensator.correct

    def ruined(self: Compensator, nominal_q: np.ndarray, loads: Loads | None = None) -> Correction:
        found = correct(self, nominal_q, loads)
        return found._replace(q=found.q * np.nan) if flag.exists() else found

    Compensator.correct = ruined  # type: ignore[method-assign]
    return load(path)
