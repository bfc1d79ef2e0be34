"""``gapbridge fleet`` from end to end, with real processes that are killed."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from on_a_phone import CHROMIUM, faults_on_a_phone
from pyarrow import parquet

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cli.log import fleet
from gapbridge.core.arm import builtin_arm
from gapbridge.core.log.log import read_log
from gapbridge.core.model import Model
from tests.bridge.cli_runs import (
    AXIAL,
    bent_model,
    cell_in,
    columns_of,
    gapbridge,
    log_in,
    measured,
    poses_and_loads,
    refused,
)
from tests.bridge.fleet.fleet_in import logs_in

ROOT = Path(__file__).parents[3]
NAMES = [f"arm{i}/s{k}" for i in range(4) for k in range(3)]


def rows_of(path: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = parquet.read_table(path).to_pylist()
    return rows


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """Return a folder with a fitted fleet, one of its logs bad, and the output of the command."""
    folder = tmp_path_factory.mktemp("fleet")
    logs = logs_in(folder, NAMES)
    (logs / "arm1" / "s9.csv").write_text("payload\nheavy\n")
    answer = gapbridge(
        "fleet", "fit", logs, "--cell", cell_in(folder), "--out", folder / "out", "--workers", 1,
        "--apply", folder / "cells",
    )  # fmt: skip
    return folder, answer


def test_by_default_a_fit_does_not_overwrite_the_results_of_a_diagnosis() -> None:
    folders = [
        next(option.default for option in command.params if option.name == "out")
        for command in (fleet.diagnose, fleet.fit)
    ]
    assert len(set(folders)) == 2


def test_a_bad_log_is_reported_in_one_line_and_the_others_are_fitted(fitted: Any) -> None:
    folder, answer = fitted
    assert answer.code == 0
    [line] = [line for line in answer.err.splitlines() if line.startswith("skipped: ")]
    assert "s9.csv" in line
    assert "found 'heavy', expected a number" in line
    assert (
        "13 sessions of 4 arms (arm: name of the folder): 12 done, 1 cannot be used" in answer.out
    )
    sessions = rows_of(folder / "out" / "sessions.parquet")
    assert len(sessions) == 13
    [bad] = [s for s in sessions if s["state"] == "bad"]
    assert "heavy" in bad["error"]
    for session in sessions:
        if session["state"] == "done":
            assert session["gap_held_out"] < 0.1 * session["gap_before"]


def test_the_table_has_types_arms_and_sessions_with_intervals(fitted: Any) -> None:
    folder, _ = fitted
    rows = rows_of(folder / "out" / "results.parquet")
    counts = {level: sum(r["level"] == level for r in rows) for level in
              ("type", "arm", "session")}  # fmt: skip
    assert counts == {"type": 12, "arm": 48, "session": 144}
    for row in rows:
        if row["level"] == "arm" and row["parameter"] == "axial_compliance_2":
            assert row["low"] <= AXIAL[1] <= row["high"]
            assert row["joint"] == 2


def test_the_new_cells_carry_what_was_found_and_their_table_is_one_for_the_next_run(
    fitted: Any,
) -> None:
    folder, _ = fitted
    with (folder / "cells" / "cells.csv").open() as file:
        table = {row["arm"]: row["cell"] for row in csv.DictReader(file)}
    assert set(table) == {"arm0", "arm1", "arm2", "arm3"}
    q, loads = poses_and_loads(20, 99)
    truth = bent_model().predict(q, loads).position
    rigid = Model(builtin_arm("ur10e")).predict(q, loads).position
    for name in table.values():
        found = load_cell(folder / "cells" / name).model.predict(q, loads).position
        assert np.abs(found - truth).max() < 0.1 * np.abs(rigid - truth).max()


def test_the_new_cells_state_where_they_come_from(fitted: Any) -> None:
    folder, _ = fitted
    cell = load_cell(folder / "cells" / "arm1.yaml")
    origin = cell.file.provenance
    assert origin.command == "fleet fit"
    assert origin.arguments["apply"] == str(folder / "cells")
    assert [(f.role, f.name) for f in origin.files] == [
        ("log", "s0.csv"), ("log", "s1.csv"), ("log", "s2.csv"), ("cell", "cell.yaml"),
    ]  # fmt: skip
    own = [read_log(folder / "logs" / "arm1" / f"s{k}.csv", 6) for k in range(3)]
    low = min(float(log.get("actual_q")[:, 2].min()) for log in own)
    assert cell.fitted_range["actual_q_2"][0] == low
    [row] = [
        r for r in rows_of(folder / "out" / "results.parquet")
        if (r["level"], r["arm"], r["parameter"]) == ("arm", "arm1", "axial_compliance_2")
    ]  # fmt: skip
    index = cell.spread.names.index("axial_compliance_2")
    assert np.sqrt(cell.spread.covariance[index, index]) == pytest.approx(row["std"])
    assert cell.intervals["axial_compliance_2"][1] == pytest.approx(row["high"])


def test_a_second_run_does_nothing_anew_and_comes_to_the_same(fitted: Any) -> None:
    folder, _ = fitted
    before = rows_of(folder / "out" / "results.parquet")
    begin = (folder / "out" / "fit.jsonl").read_bytes()
    answer = gapbridge(
        "fleet", "fit", folder / "logs", "--cell", folder / "cell.yaml", "--out", folder / "out"
    )
    assert "13 of them known from an earlier run" in answer.out
    assert "local process" not in answer.out
    assert (folder / "out" / "fit.jsonl").read_bytes() == begin
    assert rows_of(folder / "out" / "results.parquet") == before


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_nothing_of_the_report_is_cut_off_on_a_phone(fitted: Any) -> None:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    folder, _ = fitted
    assert faults_on_a_phone(playwright, folder / "out" / "report.html") == []


def test_the_report_needs_nothing_else_and_names_the_skipped_log(fitted: Any) -> None:
    folder, _ = fitted
    page = (folder / "out" / "report.html").read_text()
    assert "s9.csv" in page
    assert "arm3" in page
    assert "What to do now" in page
    assert "http" not in page.replace("http://www.w3.org/2000/svg", "")


@pytest.mark.slow
def test_diagnose_shows_the_effect_that_recurs(tmp_path: Path) -> None:
    for seed in range(3):
        q, loads = poses_and_loads(14, seed)
        shifted = q.copy()
        shifted[:, 1] += 1e-3 * (1 + seed)
        columns = columns_of(q, loads)
        columns |= measured(Model(builtin_arm("ur10e")), shifted, loads, noise=2e-5)
        place = tmp_path / "logs" / f"arm{seed}"
        place.mkdir(parents=True)
        log_in(place, columns, "s.csv")
    answer = gapbridge(
        "fleet", "diagnose", tmp_path / "logs", "--cell", cell_in(tmp_path), "--workers", 1,
        "--out", tmp_path / "out",
        *(f"--withhold={e}" for e in ("axial_compliance", "radial_compliance", "link_flexibility",
                                      "stiffness_nonlinearity", "transmission_error")),
    )  # fmt: skip
    assert answer.code == 0, answer.err
    assert "joint_offset, joint 2): 3 of 3 sessions, 3 of 3 arms" in answer.out
    rows = [r for r in rows_of(tmp_path / "out" / "results.parquet") if r["accused"]]
    values = {r["arm"]: r["value"] for r in rows if r["parameter"] == "joint_offset_2"}
    assert values == pytest.approx({f"arm{i}": 1e-3 * (1 + i) for i in range(3)}, rel=0.1)
    assert len(rows_of(tmp_path / "out" / "sessions.parquet")) == 3


@pytest.mark.slow
def test_a_run_that_is_killed_loses_nothing(tmp_path: Path) -> None:
    logs = logs_in(tmp_path, NAMES)
    cell_in(tmp_path)
    out = tmp_path / "out"
    command = [
        sys.executable, "-m", "gapbridge", "fleet", "fit", str(logs), "--cell",
        str(tmp_path / "cell.yaml"), "--out", str(out), "--workers", "1",
    ]  # fmt: skip
    journal = out / "fit.jsonl"
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        while not (journal.exists() and journal.read_bytes().count(b"\n") >= 2):
            assert process.poll() is None
            time.sleep(0.005)
        os.kill(process.pid, signal.SIGKILL)
    before = journal.read_bytes().count(b"\n")
    answer = gapbridge(*command[3:])
    assert answer.code == 0
    assert f"{before} of them known from an earlier run" in answer.out
    sessions = [json.loads(line)["session"] for line in journal.read_text().splitlines()]
    assert sorted(sessions) == sorted(NAMES)


def test_no_usable_log_is_refused(tmp_path: Path) -> None:
    logs = logs_in(tmp_path, ["a/s"])
    (logs / "a" / "s.csv").write_text("nothing\n1\n")
    reported = gapbridge("fleet", "fit", logs, "--cell", cell_in(tmp_path), "--workers", 1,
                     "--out", tmp_path / "out")  # fmt: skip
    assert reported.code == 2
    assert reported.err.splitlines()[-1].startswith("error: found no usable session among 1")


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (["nowhere"], "nowhere: not found"),
        (["logs", "--workers", "1", "--scheduler", "tcp://127.0.0.1:9"], "beside --scheduler"),
        (["logs", "--out", "cell.yaml"], "found a file, expected a folder for --out"),
        (["logs", "--cell", "none.yaml"], "none.yaml: file not found"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(
    arguments: list[str], reported: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs_in(tmp_path, ["a/s"])
    cell_in(tmp_path)
    monkeypatch.chdir(tmp_path)
    given = arguments if "--cell" in arguments else [*arguments, "--cell", "cell.yaml"]
    assert reported in refused("fleet", "fit", *given)


def test_without_the_extra_a_scheduler_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    answer = gapbridge("fleet", "fit", logs_in(tmp_path, ["a/s"]), "--cell", cell_in(tmp_path),
                       "--scheduler", "tcp://127.0.0.1:9", "--out", tmp_path / "out")  # fmt: skip
    assert answer.code == 1
    assert "expected the extra 'fleet': pip install 'gapbridge[fleet]'" in answer.err
    assert answer.err.count("\n") == 1


def test_the_tables_of_a_run_are_no_sessions_of_it(tmp_path: Path) -> None:
    (tmp_path / "arms.csv").write_text("arm,cell\na1,a1.yaml\n")
    new_cells = tmp_path / "new"
    new_cells.mkdir()
    (new_cells / "cells.csv").write_text("arm,cell\na1,a1.yaml\n")
    line = refused("fleet", "fit", tmp_path, "--cell", tmp_path / "arms.csv", "--apply", new_cells,
                   "--out", tmp_path / "out")  # fmt: skip
    assert "found only tables of a run, expected logs" in line


def two_cells_in(folder: Path) -> Path:
    """Write a table of the cells of arms A and B, and return it."""
    cells = folder / "cells"
    cells.mkdir()
    for arm in "AB":
        cell_in(cells).rename(cells / f"{arm}.yaml")
    table = cells / "cells.csv"
    table.write_text("arm,cell\nA,A.yaml\nB,B.yaml\n")
    return table


@pytest.mark.parametrize("given", ["table", "table elsewhere", "cell", "link"])
def test_no_input_cell_is_replaced_by_a_new_one(tmp_path: Path, given: str) -> None:
    table = two_cells_in(tmp_path)
    cells = table.parent
    logs, cell, new = logs_in(tmp_path, ["A/s0"]), table, cells
    if given == "table elsewhere":
        cell = tmp_path / "arms.csv"
        cell.write_text("arm,cell\nA,cells/A.yaml\n")
    elif given == "cell":
        cell = cells / "A.yaml"
    elif given == "link":
        new = tmp_path / "new"
        new.symlink_to(cells)
    before = {path.name: path.read_bytes() for path in cells.iterdir()}
    line = refused("fleet", "fit", logs, "--cell", cell, "--apply", new,
                   "--out", tmp_path / "out")  # fmt: skip
    assert "expected another folder for --apply" in line
    assert {path.name: path.read_bytes() for path in cells.iterdir()} == before


def test_no_cell_beside_a_log_is_replaced_by_a_new_one(tmp_path: Path) -> None:
    logs = logs_in(tmp_path, ["A"])
    cell = cell_in(tmp_path).rename(logs / "A.yaml")
    before = cell.read_bytes()
    line = refused("fleet", "fit", logs, "--cell", "beside", "--apply", logs,
                   "--out", tmp_path / "out")  # fmt: skip
    assert "expected another folder for --apply" in line
    assert cell.read_bytes() == before
