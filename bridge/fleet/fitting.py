"""The work on one session: what it says about the arm's compliance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.fleet.diagnosing import facts
from gapbridge.core.estimation.compliance_fit import flexibilities, usual_flexibility
from gapbridge.core.estimation.hierarchical_evidence import evidence
from gapbridge.core.log.log import Log


def work(cell: Cell, log: Log, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the session's equations for the flexibilities, and what the cell says of them."""
    found = evidence(cell.model, log, cell.metrology)
    return {
        **facts(cell, log),
        "nominal": flexibilities(cell.model).tolist(),
        "usual": usual_flexibility(cell.model),
        "evidence": {
            "matrix": found.matrix.tolist(), "right": found.right.tolist(),
            "squares": found.squares, "freedom": found.freedom, "least": found.least,
            "poses": found.poses, "wild": found.outliers,
        },
    }  # fmt: skip
