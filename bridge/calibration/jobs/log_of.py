"""A session's readings as a log, for `gapbridge diagnose` and `fit`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gapbridge.bridge.document.output_file import write_table
from gapbridge.core.calibration.readings import Readings


def write_log(readings: Readings, registered: bool, path: Path) -> None:
    """Write readings in a log's columns; those that an instrument did not give are left out.

    A log has one frame: of an instrument that was moved, rows of its first place alone are written.
    """
    rows = readings if registered else readings[readings.station == 0]
    if rows.kind in ("position", "pose"):
        rows = rows[rows.target == 0]
    n, loads = rows.q.shape[1], rows.loads
    columns: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float64]]] = {
        "timestamp": np.arange(len(rows), dtype=float),
        **{f"actual_q_{i}": rows.q[:, i] for i in range(n)},
    }
    if loads.payload_mass is not None and loads.payload_cog is not None:
        columns["payload"] = loads.payload_mass
        columns |= {f"payload_cog_{i}": loads.payload_cog[:, i] for i in range(3)}
    if loads.approach is not None:
        columns |= {f"approach_{i}": loads.approach[:, i] for i in range(n)}
    if loads.temperature is not None:
        columns |= {f"joint_temperatures_{i}": loads.temperature[:, i] for i in range(n)}
    if rows.kind in ("position", "pose"):
        columns |= {f"measured_position_{i}": rows.value[:, i] for i in range(3)}
    if rows.kind == "pose":
        columns |= {f"measured_rotation_{i}": rows.value[:, 3 + i] for i in range(3)}
    write_table(path, list(columns), np.column_stack(list(columns.values())))
