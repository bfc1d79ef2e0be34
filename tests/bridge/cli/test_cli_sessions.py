"""Several logs on the command line: diagnosed and fitted as sessions, provenance, warnings."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli_runs import (
    CELL,
    columns_of,
    gapbridge,
    log_in,
    measured,
    poses_and_loads,
    refused,
)
from cli_runs import (
    cell_in as registered_cell_in,
)

from gapbridge.bridge.cell import load_cell
from gapbridge.core.arm import builtin_arm
from gapbridge.core.effects import Site, Term
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix

SOFT = Model(builtin_arm("ur10e")).with_terms([Term("axial_compliance", Site(2), (2e-5,))])
FRAMES = {"a.csv": (np.array([0.2, -0.4, 1.0]), 1.0), "b.csv": (np.array([-1.0, 0.3, 0.2]), -2.0)}


def cell_in(folder: Path) -> Path:
    return registered_cell_in(folder, CELL.replace("registered: true", "registered: false"))


def session(folder: Path, name: str, seed: int, start: float = 0.0, rows: int = 40) -> Path:
    q, loads = poses_and_loads(rows, seed)
    columns = columns_of(q, loads) | measured(SOFT, q, loads, noise=2e-5)
    turn, shift = FRAMES[name]
    R = rotation_matrix(turn[None])[0]
    names = [f"measured_position_{i}" for i in range(3)]
    position = np.column_stack([columns[n] for n in names]) @ R.T + shift
    columns |= {n: position[:, i] for i, n in enumerate(names)}
    columns["timestamp"] = start + 10.0 * np.arange(rows)
    return log_in(folder, columns, name)


@pytest.fixture(scope="module")
def answered(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("sessions")
    logs = [session(folder, "a.csv", 0), session(folder, "b.csv", 1, start=1e4)]
    answer = gapbridge(
        "diagnose", *logs, "--cell", cell_in(folder), "--json", folder / "d.json",
        "--out", folder / "out", "--apply", folder / "new.yaml",
    )  # fmt: skip
    assert (answer.code, answer.err) == (0, "")
    return folder, logs, answer, json.loads((folder / "d.json").read_text(encoding="utf-8"))


def test_two_logs_are_one_diagnosis(answered) -> None:
    folder, _, answer, reported = answered
    assert reported["sessions"] == ["a.csv", "b.csv"]
    (channel,) = reported["channels"]
    assert [c["effect"] for c in channel["causes"]] == ["axial_compliance"]
    for figure in (
        "remaining_rms_held_out",
        "remaining_rms_new_region",
        "remaining_rms_new_session",
    ):
        assert channel[figure] == pytest.approx(2e-5, rel=0.3)
    assert [s["session"] for s in channel["sessions"]] == ["a.csv", "b.csv"]
    assert channel["causes"][0]["across_sessions"]["carries"] is True
    for arguments in ("new region of joint space", "in a new session 0.0", "carries"):
        assert arguments in answer.out
    report = (folder / "out" / "report.html").read_text(encoding="utf-8")
    for arguments in ("in a new region", "in a new session", "residual under a fit of the others"):
        assert arguments in report


def test_sessions_of_a_registered_instrument_are_fitted(tmp_path: Path) -> None:
    q, loads = poses_and_loads(80)
    columns = columns_of(q, loads) | measured(SOFT, q, loads, noise=2e-5)
    logs = [
        log_in(tmp_path, {name: v[rows] for name, v in columns.items()}, f"{rows.start}.csv")
        for rows in (slice(0, 40), slice(40, 80))
    ]
    cell, out = registered_cell_in(tmp_path), tmp_path / "fitted.yaml"
    answer = gapbridge("fit", *logs, "--cell", cell, "--out", out)
    assert answer.code == 0, answer.err
    assert "a new session" in answer.out
    assert load_cell(out).model.compliance()[0][1] == pytest.approx(2e-5, rel=0.02)


def test_provenance_stands_in_the_json_and_in_the_cell(answered) -> None:
    folder, logs, _, reported = answered
    origin = reported["provenance"]
    assert set(origin) == {"version", "time", "command", "arguments", "files"}
    assert origin["command"] == "diagnose"
    assert origin["arguments"]["logs"] == [str(log) for log in logs]
    assert origin["arguments"]["apply"] == str(folder / "new.yaml")
    assert [(f["role"], f["name"]) for f in origin["files"]] == [
        ("log", "a.csv"), ("log", "b.csv"), ("cell", "cell.yaml"),
    ]  # fmt: skip
    for entry in origin["files"]:
        bytes_ = (folder / entry["name"]).read_bytes()
        assert entry["sha256"] == hashlib.sha256(bytes_).hexdigest()
    written = yaml.safe_load((folder / "new.yaml").read_text(encoding="utf-8"))["provenance"]
    fitted = written.pop("fitted")
    parameters, covariance = written.pop("parameters"), np.array(written.pop("covariance"))
    assert covariance.shape == (len(parameters),) * 2
    assert (np.diag(covariance) > 0).all()
    intervals = written.pop("intervals")
    causes = [c for channel in reported["channels"] for c in channel["causes"]]
    assert [c["effect"] for c in written.pop("causes")] == [c["effect"] for c in causes]
    assert written == origin
    applied = [
        p for c in reported["channels"] for cause in c["causes"] for p in cause["parameters"]
    ]
    assert set(intervals) == {p["name"] for p in applied}
    for p in applied:
        low, high = intervals[p["name"]]
        assert (low + high) / 2 == pytest.approx(p["value"])
        assert (high - low) / 2 == pytest.approx(1.96 * p["std"])
    assert set(fitted) >= {"actual_q_0", "actual_q_5", "payload"}
    assert load_cell(folder / "new.yaml").fitted_range["payload"] == tuple(fitted["payload"])


def test_rows_outside_what_was_fitted_are_warned_of(answered) -> None:
    folder, logs, _, _ = answered
    out = ("--cell", folder / "new.yaml", "--out", folder / "p.csv")
    assert gapbridge("predict", logs[0], *out).err == ""
    q, loads = poses_and_loads(5)
    columns = columns_of(q, loads)
    low, high = load_cell(folder / "new.yaml").fitted_range["actual_q_5"]
    columns["actual_q_5"] = np.full(5, high + 0.2 * (high - low) + 0.1)
    turned = log_in(folder, columns, "turned.csv")
    for command in ("predict", "compensate"):
        answer = gapbridge(command, turned, *out)
        assert answer.code == 0
        (line,) = answer.err.splitlines()
        for word in (
            "warning: ",
            "turned.csv",
            "joint 6 (actual_q_5): 5 of 5 rows",
            "outside what was fitted",
        ):
            assert word in line
    assert gapbridge("predict", turned, "--cell", folder / "cell.yaml", "--out", out[3]).err == ""


def test_two_logs_are_one_fit(tmp_path: Path) -> None:
    logs = [session(tmp_path, "a.csv", 0), session(tmp_path, "b.csv", 1)]
    answer = gapbridge("fit", *logs, "--cell", cell_in(tmp_path), "--out", tmp_path / "f.yaml")
    assert answer.code == 0, answer.err
    for arguments in ("over 80 poses", "to expect in a new session", "to expect in a new region"):
        assert arguments in answer.out
    cell = load_cell(tmp_path / "f.yaml")
    assert cell.model.compliance()[0][1] == pytest.approx(2e-5, rel=0.05)
    assert cell.file.provenance is not None
    assert cell.file.provenance.command == "fit"
    low, high = cell.intervals["axial_compliance_2"]
    assert low < 2e-5 < high
    assert high - low < 5e-6


def both_in(folder: Path) -> Path:
    """Write a log of two sessions in a column."""
    parts = [session(folder, name, i).read_text().splitlines() for i, name in enumerate(FRAMES)]
    rows = [f"{line},{i + 1}" for i, part in enumerate(parts) for line in part[1:]]
    log = folder / "both.csv"
    log.write_text("\n".join([parts[0][0] + ",session", *rows]) + "\n", encoding="utf-8")
    return log


def test_a_column_session_is_read_too(tmp_path: Path) -> None:
    log = both_in(tmp_path)
    answer = gapbridge("fit", log, "--cell", cell_in(tmp_path), "--out", tmp_path / "f.yaml")
    assert answer.code == 0, answer.err
    assert "to expect in a new session" in answer.out


def test_a_check_gives_each_session_of_a_column_its_own_frame(tmp_path: Path) -> None:
    answer = gapbridge("check", cell_in(tmp_path), "--log", both_in(tmp_path))
    assert (answer.code, answer.err) == (0, "")


def test_a_fleet_gives_each_session_of_a_column_its_own_frame(tmp_path: Path) -> None:
    (tmp_path / "arm").mkdir()
    both_in(tmp_path).rename(tmp_path / "arm" / "both.csv")
    answer = gapbridge(
        "fleet", "fit", tmp_path / "arm", "--cell", cell_in(tmp_path), "--workers", 1,
        "--out", tmp_path / "out", "--apply", tmp_path / "cells",
    )  # fmt: skip
    assert answer.code == 0, answer.err
    (cell,) = (tmp_path / "cells").glob("*.yaml")
    assert load_cell(cell).model.compliance()[0][1] == pytest.approx(2e-5, rel=0.05)


def test_sessions_of_another_arm_are_refused_in_one_line(tmp_path: Path) -> None:
    a = session(tmp_path, "a.csv", 0)
    text = a.read_text(encoding="utf-8").splitlines()
    b = tmp_path / "b.csv"
    b.write_text("\n".join([text[0] + ",actual_q_6", *(t + ",0.1" for t in text[1:])]) + "\n")
    for command in ("diagnose", "fit"):
        more = ("--out", tmp_path / "f.yaml") if command == "fit" else ()
        line = refused(command, a, b, "--cell", cell_in(tmp_path), *more)
        for word in ("b.csv", "actual_q_6", "one too many", "6-joint arm"):
            assert word in line


def test_clocks_that_overlap_are_noted(tmp_path: Path) -> None:
    logs = [session(tmp_path, "a.csv", 0, rows=12), session(tmp_path, "b.csv", 1, rows=12)]
    answer = gapbridge("diagnose", *logs, "--cell", cell_in(tmp_path))
    assert answer.code == 0, answer.err
    assert "the sessions' timestamps overlap" in answer.out


def test_a_copy_of_a_log_is_no_further_session_and_no_simulation(tmp_path: Path) -> None:
    q, loads = poses_and_loads(40)
    columns, cell = columns_of(q, loads) | measured(SOFT, q, loads), cell_in(tmp_path)
    log, copy = log_in(tmp_path, columns), log_in(tmp_path, columns, "copy.csv")
    for command, more in (("fit", ("--out", tmp_path / "new.yaml")), ("diagnose", ())):
        line = refused(command, log, copy, "--cell", cell, *more)
        assert f"{copy}: found the rows of {log}, expected each log once" in line
    line = refused("diagnose", log, "--sim", copy, "--cell", cell)
    assert f"{copy}: found the rows of {log}, expected a simulator's log" in line
