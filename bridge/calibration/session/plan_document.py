"""A plan as a journal entry, and as a CSV table for the robot program."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.bridge.document.output_file import write_table
from gapbridge.core.calibration.plan import Expectation, Payload, Plan, PlannedPose
from gapbridge.core.notes import Note, Reason


def plan_of(entry: dict[str, Any]) -> Plan:
    """Return the plan of a journal entry."""
    expected = entry["expected"]
    return Plan(
        loads=tuple(
            Payload(float(p["mass"]), _vector3(p["cog"]), str(p["name"])) for p in entry["loads"]
        ),
        poses=tuple(_pose(p) for p in entry["poses"]),
        expected=Expectation(
            names=tuple(expected["names"]), units=tuple(expected["units"]),
            std=_array(expected["std"]), prior=_array(expected["prior"]),
            tcp_std=float(expected["tcp_std"]), tcp_std_worst=float(expected["tcp_std_worst"]),
        ),
        bought=tuple((int(n), float(s)) for n, s in entry["bought"]),
        travel=float(entry["travel"]),
        notes=tuple(Note(Reason[name], tuple(values)) for name, values in entry["notes"]),
    )  # fmt: skip


def entry_of(plan: Plan) -> dict[str, Any]:
    """Return the journal entry of a plan."""
    return {**asdict(plan), "notes": [(note.reason.name, note.values) for note in plan.notes]}


def _pose(entry: dict[str, Any]) -> PlannedPose:
    return PlannedPose(**{**entry, "q": _array(entry["q"]), "approach": _array(entry["approach"])})


def _array(values: list[Any]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.array([float(v) for v in values])


def _vector3(values: list[Any]) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def write_poses(plan: Plan, path: Path) -> None:
    """Write the stops as CSV in the order of travel: stop (from 1), place, load, joints in rad."""
    n = len(plan.poses[0].q)
    rows = [
        (i + 1, p.number, p.station, p.load, plan.loads[p.load].mass, p.held_out, p.repeat, *p.q)
        for i, p in enumerate(plan.poses)
    ]
    names = ["stop", "pose", "place", "load", "payload", "held_out", "repeat"]
    write_table(path, [*names, *(f"target_q_{i}" for i in range(n))], np.array(rows, dtype=float))
