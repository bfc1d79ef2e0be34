"""Values of a fleet's sessions that are compared: not the times of steps, and by their sigmas."""

from __future__ import annotations

import io
from typing import Any

import pytest
from pyarrow.parquet import read_table

from gapbridge.bridge.fleet.diagnosis_summary import summarise
from gapbridge.bridge.fleet.output import EFFECT_COLUMNS, effect_rows, parquet
from gapbridge.bridge.fleet.session_work import _rows
from gapbridge.bridge.fleet.task import DONE, Outcome

SESSIONS = 12


def slipped(k: int, clocks_overlap: bool, more: float = 0.0, std: float = 1e-5) -> Outcome:
    """Return the diagnosis of a session in which joint 2 has slipped."""
    moment = 1.7e9 + 86400.0 * 10**k
    when: list[dict[str, Any]] = [
        {"name": "joint_slip_2_time", "value": moment, "std": 10.0, "unit": "s"}
    ]
    if clocks_overlap:
        when[0] |= {"value": None, "std": None}
        when += [{"name": "joint_slip_2_session", "value": "2", "std": None, "unit": ""}]
    size = {"name": "joint_slip_2", "value": 3e-3 + 1e-7 * k + more, "std": std, "unit": "rad"}
    cause = {
        "effect": "joint_slip", "joints": [2], "probability": 1.0, "shrink": 0.9,
        "shrink_interval": [0.8, 0.95], "shrink_alone": 0.9, "indistinguishable_from": [],
        "parameters": [size, *when],
    }  # fmt: skip
    rows = _rows({"channel": "position", "causes": [cause], "considered": []})
    result = {"type": "ur10e", "joints": 6, "poses": 90, "time": 1.7e9 + 86400.0 * k,
              "verdict": "explained", "channels": [], "rows": rows}  # fmt: skip
    return Outcome(str(k), "a", f"a/s{k}", "s.csv", "cell.yaml", DONE, 1.0, result=result)


@pytest.mark.parametrize("clocks_overlap", [False, True])
def test_times_of_slips_neither_drift_nor_stand_out(clocks_overlap: bool) -> None:
    outcomes = [slipped(k, clocks_overlap) for k in range(SESSIONS)]
    summary = summarise(outcomes)
    assert not summary.outliers
    assert all(drift.quantity == "joint_slip_2" for drift in summary.drifts)
    table = read_table(io.BytesIO(parquet(EFFECT_COLUMNS, list(effect_rows(outcomes)))))
    names = set(table.column("parameter").to_pylist())
    assert names == {"joint_slip_2", "joint_slip_2_time"}


@pytest.mark.parametrize(("std", "stands_out"), [(1e-5, True), (1e-3, False)])
def test_a_session_stands_out_only_beyond_its_own_sigma(std: float, stands_out: bool) -> None:
    sessions = [slipped(k, clocks_overlap=True) for k in range(SESSIONS - 1)]
    far = slipped(SESSIONS - 1, clocks_overlap=True, more=2e-3, std=std)
    found = [outlier.session for outlier in summarise([*sessions, far]).outliers]
    assert found == ([far.session] if stands_out else [])
