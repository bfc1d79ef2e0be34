"""Sessions of a fleet: their logs, arms and cells."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from gapbridge.bridge.fleet.cell_source import CellNearLog, CellTable, OneCell, cell_source
from gapbridge.bridge.fleet.output import (
    DIAGNOSIS_COLUMNS,
    EFFECT_COLUMNS,
    FIT_COLUMNS,
    FLEXIBILITY_COLUMNS,
    parquet,
    session_rows,
)
from gapbridge.bridge.fleet.runner import make_tasks
from gapbridge.bridge.fleet.session import (
    RESULTS_FILE,
    SESSIONS_FILE,
    Fleet,
    find_sessions,
    natural_key,
)
from gapbridge.bridge.fleet.task import BAD
from gapbridge.core.errors import InputError
from tests.bridge.fleet.jobs import count_rows


def files_in(folder: Path, *names: str) -> Path:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return folder


def arms_of(found: Fleet) -> dict[str, str]:
    return {s.name: s.arm for s in found.sessions}


def test_the_first_folder_reports_the_arm_and_names_sort_by_their_numbers(tmp_path: Path) -> None:
    files_in(tmp_path, "b/s10.csv", "b/s9.parquet", "a/2026/s1.CSV", "a/notes.txt")
    found = find_sessions([str(tmp_path)])
    assert list(arms_of(found).items()) == [("a/2026/s1", "a"), ("b/s9", "b"), ("b/s10", "b")]
    assert found.arms == 2
    assert "folder" in found.rule


def test_a_digit_that_is_no_number_is_text() -> None:
    assert sorted(["cell 10²3", "cell 9²3"], key=natural_key) == ["cell 9²3", "cell 10²3"]


def test_of_logs_in_one_folder_the_name_reports_the_arm(tmp_path: Path) -> None:
    files_in(tmp_path, "ur7_monday.csv", "ur7_friday.csv", "ur8.csv")
    assert set(arms_of(find_sessions([str(tmp_path)])).values()) == {"ur7", "ur8"}


def test_a_glob_and_the_files_it_stands_for_come_to_the_same(tmp_path: Path) -> None:
    files_in(tmp_path, "a/s1.csv", "b/s1.csv", "b/skip.txt")
    glob = find_sessions([str(tmp_path / "*" / "*")])
    listed = find_sessions([str(tmp_path / "a" / "s1.csv"), str(tmp_path / "b" / "s1.csv")])
    assert arms_of(glob) == arms_of(listed) == {"a/s1": "a", "b/s1": "b"}


def test_a_link_to_a_log_of_the_fleet_is_not_counted_again(tmp_path: Path) -> None:
    files_in(tmp_path, "logs/a/s1.csv", "logs/a/s2.csv", "archive/s3.csv")
    (tmp_path / "logs/a/latest.csv").symlink_to("s2.csv")
    (tmp_path / "logs/a/s3.csv").symlink_to(tmp_path / "archive/s3.csv")
    found = find_sessions([str(tmp_path / "logs")])
    assert [s.name for s in found.sessions] == ["a/s1", "a/s2", "a/s3"]


def test_a_pattern_finds_the_arm(tmp_path: Path) -> None:
    files_in(tmp_path, "hall1/line-a.csv", "hall2/line-a.csv")
    found = find_sessions([str(tmp_path)], r"(hall\d)/")
    assert set(arms_of(found).values()) == {"hall1", "hall2"}
    with pytest.raises(InputError, match="--arm: 'x9' does not fit"):
        find_sessions([str(tmp_path)], "x9")
    for empty in ("", r"(zz)?"):
        with pytest.raises(InputError, match=r"--arm: .* matches nothing of"):
            find_sessions([str(tmp_path)], empty)
    with pytest.raises(InputError, match="no regular expression"):
        find_sessions([str(tmp_path)], "(")


def test_a_runs_tables_are_no_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files_in(tmp_path, "a/s.csv", "out/results.parquet", "cells.csv")
    monkeypatch.chdir(tmp_path)
    tables = [tmp_path / "out" / "results.parquet", Path("a/../cells.csv")]
    assert list(arms_of(find_sessions(["."], without=tables))) == ["a/s"]
    files_in(tmp_path, "out/s.csv")  # a folder of logs as the output folder loses none
    assert list(arms_of(find_sessions(["."], without=tables))) == ["a/s", "out/s"]
    with pytest.raises(InputError, match="found only tables of a run, expected logs"):
        find_sessions(["cells.csv"], without=tables)


def test_tables_of_an_earlier_run_are_no_logs_of_the_next(tmp_path: Path) -> None:
    files_in(tmp_path, "a/s.csv", "b/results.parquet")  # the latter of somebody else
    (tmp_path / "out").mkdir()
    for name, columns in ((RESULTS_FILE, FLEXIBILITY_COLUMNS), (SESSIONS_FILE, FIT_COLUMNS)):
        (tmp_path / "out" / name).write_bytes(parquet(columns, []))
    (tmp_path / "cells.csv").write_text("arm,cell\na,a.yaml\n")
    assert list(arms_of(find_sessions([str(tmp_path)]))) == ["a/s", "b/results"]
    for columns in (EFFECT_COLUMNS, DIAGNOSIS_COLUMNS):
        (tmp_path / "b" / RESULTS_FILE).write_bytes(parquet(columns, []))
        assert list(arms_of(find_sessions([str(tmp_path)]))) == ["a/s"]


def test_a_copy_of_another_arms_log_is_skipped(tmp_path: Path) -> None:
    for name, text in (("arm1/s", "a"), ("arm2/s", "b"), ("arm10/s", "a")):
        files_in(tmp_path / "logs", f"{name}.csv")
        (tmp_path / "logs" / f"{name}.csv").write_text(text, encoding="utf-8")
    (tmp_path / "cell.yaml").write_text("robot: {model: ur10e}\n", encoding="utf-8")
    sessions = find_sessions([str(tmp_path / "logs")]).sessions
    tasks, [bad] = make_tasks(sessions, OneCell(tmp_path / "cell.yaml"), count_rows, {})
    assert [task.arm for task in tasks] == ["arm1", "arm2"]
    assert (bad.arm, bad.state) == ("arm10", BAD)
    assert bad.error.endswith("arm1/s.csv, expected each log once")


def test_a_log_whose_name_is_not_utf8_is_skipped(tmp_path: Path) -> None:
    files_in(tmp_path, os.fsdecode(b"a/s\xff.csv"), "a/t.csv", "cell.yaml")
    sessions = find_sessions([str(tmp_path / "a")]).sessions
    tasks, [bad] = make_tasks(sessions, OneCell(tmp_path / "cell.yaml"), count_rows, {})
    assert [task.log.name for task in tasks] == ["t.csv"]
    assert (bad.state, bad.session) == (BAD, r"s\udcff")
    assert r"s\udcff.csv: found a name that is not UTF-8" in bad.error
    parquet(FIT_COLUMNS, list(session_rows([bad])))


@pytest.mark.parametrize(
    ("where", "reported"),
    [("nowhere", "not found"), ("*.csv", "no log that fits"), (".", "no log in this folder")],
)
def test_no_logs_are_reported(
    where: str, reported: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=reported):
        find_sessions([where])


def test_two_logs_of_one_name_are_refused(tmp_path: Path) -> None:
    files_in(tmp_path, "a/s.csv", "a/s.parquet")
    with pytest.raises(InputError, match=re.escape("expected one log of a name")):
        find_sessions([str(tmp_path)])


def test_a_cell_beside_the_log_wins_over_those_above(tmp_path: Path) -> None:
    files_in(tmp_path / "logs", "a/s1.csv", "a/s2.csv", "b/s1.csv", "a/s1.yaml", "a/cell.yaml")
    files_in(tmp_path, "cell.yaml")
    found = find_sessions([str(tmp_path / "logs")])
    cells = cell_source("beside", found.folder)
    assert isinstance(cells, CellNearLog)
    first, second, third = found.sessions
    assert cells.cell_of(first).name == "s1.yaml"
    assert cells.cell_of(second) == tmp_path / "logs" / "a" / "cell.yaml"
    with pytest.raises(InputError, match="found no cell beside it"):  # none above the fleet's
        cells.cell_of(third)


def test_a_table_maps_arms_to_cells_seen_from_its_folder(tmp_path: Path) -> None:
    files_in(tmp_path, "logs/a/s.csv", "logs/b/s.csv")
    table = tmp_path / "cells" / "arms.csv"
    table.parent.mkdir()
    table.write_text("arm,cell,note\na,x.yaml,\n")
    cells = cell_source(str(table), tmp_path)
    assert isinstance(cells, CellTable)
    a, b = find_sessions([str(tmp_path / "logs")]).sessions
    assert cells.cell_of(a) == tmp_path / "cells" / "x.yaml"
    with pytest.raises(InputError, match="no row for arm 'b'"):
        cells.cell_of(b)


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("arm;cell\n", "header: found arm;cell, expected columns arm and cell"),
        ("arm,cell\na,x\na,y\n", "row 3: found arm 'a' twice"),
        ("arm,cell\na,\n", "row 2: found no cell"),
        ("arm,cell\na,x\0.yaml\n", "row 2: found 'a,x\\x00.yaml', expected no \\0 in it"),
    ],
)
def test_a_table_that_cannot_be_used_is_reported(text: str, reported: str, tmp_path: Path) -> None:
    table = tmp_path / "arms.csv"
    table.write_text(text)
    with pytest.raises(InputError, match=re.escape(reported)):
        cell_source(str(table), tmp_path)


def test_any_other_word_is_one_cell_for_all(tmp_path: Path) -> None:
    assert cell_source("cell.yaml", tmp_path) == OneCell(Path("cell.yaml"))


def test_a_folder_that_may_not_be_read_is_told_as_such(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files_in(tmp_path, "a/s1.csv")
    monkeypatch.setattr("os.access", lambda *_: False)  # root may read everything
    with pytest.raises(InputError, match="this user may not read the folder"):
        find_sessions([str(tmp_path)])
