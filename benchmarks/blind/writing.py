"""Writes what the diagnosis may see: log.csv and cell.yaml, as any user writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from benchmarks.blind.arms import ArmKind, urdf_text
from benchmarks.blind.mechanics import Array, RealArm


def write_log(path: Path, columns: dict[str, Array]) -> None:
    """Write columns; vectors (N, k) become ``name_0..k-1``."""
    names: list[str] = []
    values: list[Array] = []
    for name, column in columns.items():
        if column.ndim == 1:
            names.append(name)
            values.append(column)
        else:
            names += [f"{name}_{k}" for k in range(column.shape[1])]
            values += list(column.T)
    rows = zip(*(v.tolist() for v in values), strict=True)
    text = "\n".join(",".join(f"{x:.10g}" for x in row) for row in rows)
    path.write_text(",".join(names) + "\n" + text + "\n", encoding="utf-8")


def write_cell(
    folder: Path,
    kind: ArmKind,
    nominal: RealArm,
    payload: tuple[float, Array],
    metrology: dict[str, Any] | None,
) -> None:
    """Write cell.yaml (and robot.urdf where the arm is handed out as such)."""
    rpy = Rotation.from_matrix(nominal.tool_rotation).as_euler("xyz")
    cell: dict[str, Any] = {
        "robot": _robot(folder, kind),
        "tool": {"tcp": {"xyz": nominal.tool_position.tolist(), "rpy": rpy.tolist()}},
        "payload": {"mass": float(payload[0]), "cog": np.asarray(payload[1]).tolist()},
        "gravity": nominal.gravity.tolist(),
    }
    if nominal.reference_temperature != 25.0:
        cell["reference_temperature"] = nominal.reference_temperature
    if np.any(nominal.axial) or np.any(nominal.radial):
        cell["compliance"] = {"axial": nominal.axial.tolist(), "radial": nominal.radial.tolist()}
    if metrology is not None:
        cell["metrology"] = metrology
    text = yaml.safe_dump(cell, sort_keys=False)
    (folder / "cell.yaml").write_text(text, encoding="utf-8")


def _robot(folder: Path, kind: ArmKind) -> dict[str, Any]:
    if kind.as_urdf:
        (folder / "robot.urdf").write_text(urdf_text(kind), encoding="utf-8")
        return {"urdf": "robot.urdf", "tip": "flange"}
    return {
        "dh": [
            {
                "a": r.a, "alpha": r.alpha, "d": r.d, "offset": r.offset,
                "mass": r.mass, "cog": [float(x) for x in r.cog],
            }
            for r in kind.rows
        ]
    }  # fmt: skip
