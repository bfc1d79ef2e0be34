"""Every reading, pose by pose."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.report.figures import degrees, fixed
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.document.blocks import Block, Cell, Table
from gapbridge.core.arrays import Array, Index


def all_readings(material: Material) -> list[Block]:
    """Return one long table."""
    readings = material.calibration.readings
    before, after = (_by_row(e.rows, e.norm, len(readings)) for e in material.both)
    rows: list[list[Cell]] = []
    for i in range(len(readings)):
        used = (
            "outlier" if i in material.outlier_rows else "check" if readings.held_out[i] else "fit"
        )
        rows.append([
            str(i + 1), str(int(readings.pose[i]) + 1), str(int(readings.load[i]) + 1),
            degrees(readings.q[i]), used, _in_mm(before[i]), _in_mm(after[i]),
        ])  # fmt: skip
    heads = ("no.", "pose", "load", "joint angles, degrees", "used for", "before", "after")
    return [Table(heads, rows, (0.5, 0.6, 0.6, 4, 0.8, 0.8, 0.8), (5, 6))]


def _by_row(rows: Index, norm: Array, count: int) -> Array:
    found = np.full(count, np.nan)
    found[rows] = norm * 1e3
    return found


def _in_mm(value: float) -> str:
    return fixed(value, 3) if np.isfinite(value) else "–"
