"""The new cells of a fleet: all of them are written, or none."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gapbridge.bridge.fleet.output import write_cells
from gapbridge.core.errors import RunError
from tests.bridge.cli_runs import cell_in


def fitted_arm(name: str, cell: Path, log: Path, axial: float) -> Any:
    """Return an arm of which one session found the flexibility ``axial`` (rad/Nm) of joint 1."""
    flexibility = np.r_[axial, np.zeros(11)]
    outcome = SimpleNamespace(cell=str(cell), log=str(log), result={})
    fit = SimpleNamespace(
        flexibility=flexibility, std=np.full(12, 1e-7), covariance=1e-14 * np.eye(12)
    )
    return SimpleNamespace(name=name, fit=fit, sessions=[SimpleNamespace(outcome=outcome)])


@pytest.mark.parametrize(("second", "written"), [(2e-6, True), (np.nan, False)])
def test_no_cell_is_written_if_one_could_not_be_loaded(
    tmp_path: Path, second: float, written: bool
) -> None:
    cell, log, new = cell_in(tmp_path), tmp_path / "s.csv", tmp_path / "new"
    log.touch()
    new.mkdir()
    names = [f"{way}_compliance_{i}" for way in ("axial", "radial") for i in range(1, 7)]
    kind = SimpleNamespace(
        parameters=tuple(names),
        scatter=SimpleNamespace(identifiable=np.arange(12) == 0),
        arms=[fitted_arm("A", cell, log, 1e-6), fitted_arm("B", cell, log, second)],
    )
    fit: Any = SimpleNamespace(types=[kind])
    if written:
        assert [p.name for p in write_cells(fit, new)] == ["A.yaml", "B.yaml", "cells.csv"]
    else:
        with pytest.raises(RunError, match="nothing is written, the cell could not be loaded"):
            write_cells(fit, new)
        assert not [*new.iterdir()]
