"""The jobs on one session: its diagnosis as table rows, or its equations of the compliance."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.document.diagnosis_json import document
from gapbridge.core.diagnosis.diagnosis import channels_of, diagnose
from gapbridge.core.estimation.flexibilities import flexibilities, typical_flexibility
from gapbridge.core.estimation.hierarchical_evidence import evidence
from gapbridge.core.fitted_range import range_of
from gapbridge.core.log.log import Log
from gapbridge.core.sessions import with_sessions

EPOCH = 1.0e9  # s: larger timestamps are Unix times, smaller ones relative


def diagnose_session(cell: Cell, log: Log, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the diagnosis as plain JSON: facts of the session, channels, a row per parameter."""
    diagnosis = document(
        diagnose(
            cell.model,
            log,
            cell.metrology,
            withhold=options.get("withhold", ()),
            observers=channels_of(cell.uncertain),
        )
    )
    rows = [row for channel in diagnosis["channels"] for row in _rows(channel)]
    return {
        **facts(cell, log),
        "verdict": diagnosis["verdict"],
        "channels": [_channel(c) for c in diagnosis["channels"]],
        "rows": rows,
    }


def facts(cell: Cell, log: Log) -> dict[str, Any]:
    """Return arm type, number of joints and poses, and start (Unix time, s) of a session."""
    time = log.get("timestamp")
    begin = float(time[0]) if time is not None and time[0] > EPOCH else None
    return {"type": arm_type(cell), "joints": cell.arm.n, "poses": len(log), "time": begin}


def arm_type(cell: Cell) -> str:
    """Return the name of the arm's type; for DH rows a hash of them."""
    arm = cell.arm
    if arm.name != "dh":
        return arm.name
    return f"dh {zlib.crc32(np.round(arm.link_in_link, 9).tobytes()):08x}"


def _channel(channel: Mapping[str, Any]) -> dict[str, Any]:
    names = ("channel", "unit", "verdict", "samples", "gap_rms", "gap_max", "noise_floor_rms",
             "remaining_rms", "remaining_rms_held_out")  # fmt: skip
    return {
        **{name: channel[name] for name in names},
        "structured": channel["unexplained"]["structured"],
        "depends_on": [q["quantity"] for q in channel["unexplained"]["depends_on"]],
    }


def _rows(channel: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for cause in channel["causes"]:
        low, high = cause["shrink_interval"] or (None, None)
        shared = {
            "channel": channel["channel"], "effect": cause["effect"], "accused": True,
            "joints": cause["joints"], "probability": cause["probability"],
            "shrink": cause["shrink"], "shrink_low": low, "shrink_high": high,
            "shrink_alone": cause["shrink_alone"],
            "indistinguishable_from": cause["indistinguishable_from"],
        }  # fmt: skip
        rows += [
            {**shared, "parameter": p["name"], "value": p["value"], "std": p["std"],
             "unit": p["unit"]}
            for p in cause["parameters"]
            if not isinstance(p["value"], str)  # a session's name, beside a moment without value
        ]  # fmt: skip
    rows += [
        {"channel": channel["channel"], "effect": k["effect"], "accused": False,
         "probability": k["probability"], "shrink_alone": k["shrink_alone"]}
        for k in channel["considered"] if k["excited"]
    ]  # fmt: skip
    return rows


def fit_session(cell: Cell, log: Log, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return a session's equations, its columns' ranges, the flexibilities of the cell, rad/Nm."""
    equations = evidence(cell.model, with_sessions(log, cell.model), cell.metrology)
    arrays = {"matrix": equations.matrix.tolist(), "right": equations.right.tolist()}
    return {
        **facts(cell, log),
        "nominal": flexibilities(cell.model).tolist(),
        "usual": typical_flexibility(cell.model),
        "evidence": asdict(equations) | arrays,
        "range": range_of(log),
    }
