"""The commands as functions, and the examples of docs/python.md."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runs import (
    CELL,
    bent_model,
    cell_in,
    columns_of,
    gapbridge,
    log_in,
    measured,
    poses_and_loads,
    table_of,
)

from gapbridge.bridge import api

PAGE = Path(__file__).parents[3] / "docs" / "python.md"


@pytest.fixture
def desk(tmp_path: Path) -> Path:
    q, loads = poses_and_loads(60)
    cell_in(tmp_path, CELL)
    model = bent_model()
    log_in(tmp_path, columns_of(q, loads) | measured(model, q, loads, noise=2e-5))
    return tmp_path


def test_predict_and_compensate_are_what_the_commands_write(desk: Path) -> None:
    paths = desk / "log.csv", "--cell", desk / "cell.yaml", "--out"
    assert gapbridge("predict", *paths, desk / "p.csv").code == 0
    assert gapbridge("compensate", *paths, desk / "c.csv").code == 0
    cell = api.load_cell(desk / "cell.yaml")
    log = api.read_log(desk / "log.csv", cell)
    poses, corrected = api.predict(cell, log), api.compensate(cell, log)
    np.testing.assert_allclose(poses.position, table_of(desk / "p.csv")[1][:, :3], atol=1e-12)
    np.testing.assert_allclose(corrected.q, table_of(desk / "c.csv")[1], atol=1e-12)
    for found, name in ((poses, "p"), (corrected, "c")):
        found.save(desk / "saved.csv")
        assert (desk / "saved.csv").read_bytes() == (desk / f"{name}.csv").read_bytes()
    json.dumps([poses.to_json(), corrected.to_json()], allow_nan=False)
    for found in (poses.to_json(), corrected.to_json()):
        files = {file["role"]: file for file in found["provenance"]["files"]}
        for role, name in (("log", "log.csv"), ("cell", "cell.yaml")):
            true = hashlib.sha256((desk / name).read_bytes()).hexdigest()
            assert files[role]["sha256"] == true


def test_a_cell_written_from_python_holds_what_was_done_with_which_files(desk: Path) -> None:
    q, loads = poses_and_loads(40, 5)
    more = columns_of(q, loads) | measured(bent_model(), q, loads, noise=2e-5)
    logs = [desk / "log.csv", log_in(desk, more, "more.csv")]
    cell = api.load_cell(desk / "cell.yaml")
    api.fit(cell, api.read_log(logs, cell), remounted=True).save(desk / "fitted.yaml")
    origin = api.load_cell(desk / "fitted.yaml").file.provenance
    assert origin is not None
    assert origin.command == "fit"
    assert origin.arguments["log"] == [str(log) for log in logs]
    assert origin.arguments["remounted"] is True
    assert [(f.role, f.name) for f in origin.files] == [
        ("log", "log.csv"), ("log", "more.csv"), ("cell", "cell.yaml"),
    ]  # fmt: skip
    true = [hashlib.sha256(log.read_bytes()).hexdigest() for log in logs]
    assert [f.sha256 for f in origin.files][:2] == true
    shown = gapbridge("diff", desk / "cell.yaml", desk / "fitted.yaml").out
    assert "fitted.yaml was written by fit" in shown
    assert "from log.csv, more.csv" in shown


def test_a_diagnosis_writes_what_the_command_writes(desk: Path) -> None:
    paths = desk / "log.csv", "--cell", desk / "cell.yaml", "--out", desk / "command"
    new = "--apply", desk / "command.yaml", "--stand-ins"
    assert gapbridge("diagnose", *paths, *new).code == 0
    cell = api.load_cell(desk / "cell.yaml")
    found = api.diagnose(cell, api.read_log(desk / "log.csv", cell))
    report = found.write_report(desk / "own")
    found.save(desk / "own.yaml", stand_ins=True)
    assert [path.name for path in report] == ["diagnosis.json", "report.html"]
    assert found.stand_ins == ()
    own, theirs = (
        json.loads((desk / d / "diagnosis.json").read_text()) for d in ("own", "command")
    )
    assert own.pop("provenance")["files"] == theirs.pop("provenance")["files"]
    assert own == theirs
    models = [api.load_cell(desk / f"{name}.yaml").model for name in ("own", "command")]
    np.testing.assert_array_equal(*(np.concatenate(m.compliance()) for m in models))
    with pytest.raises(api.InputError, match="found no folder"):
        found.write_report(desk / "no" / "folder")


def test_what_cannot_be_used_raises_the_line_of_the_command(desk: Path) -> None:
    (desk / "bad.yaml").write_text("robot: {model: ur10e}\ngravity: [0, 0, -1]\n")
    with pytest.raises(api.InputError, match="line 2: gravity"):
        api.load_cell(desk / "bad.yaml")
    cell = api.load_cell(desk / "cell.yaml")
    with pytest.raises(api.InputError, match="found no path"):
        api.read_log([], cell)
    found = api.fit(cell, api.read_log(desk / "log.csv", cell))
    for path, line in (
        (desk / "cell.yaml", "output to be the input"),
        (desk / "no/c.yaml", "no folder"),
        (desk / "log.csv", "found .csv, expected .yaml or .yml"),
    ):
        with pytest.raises(api.InputError, match=line):
            found.save(path)
    with pytest.raises(api.InputError, match="'nonsense'"):
        api.diagnose(cell, api.read_log(desk / "log.csv", cell), withhold=["nonsense"])


def test_no_cause_is_written_for_poses_of_another_arm(desk: Path) -> None:
    q, loads = poses_and_loads(30)
    inches = {k: v / 0.0254 for k, v in measured(bent_model(), q, loads).items()}
    cell = api.load_cell(desk / "cell.yaml")
    found = api.diagnose(cell, api.read_log(log_in(desk, columns_of(q, loads) | inches), cell))
    found.save(desk / "new.yaml")
    assert api.load_cell(desk / "new.yaml").model.terms == cell.model.terms


def test_the_examples_of_the_page_run(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(desk)
    names: dict[str, object] = {}
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 5
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), names)
    found, reported = names["found"], names["reported"]
    assert isinstance(found, api.Fitted)
    assert isinstance(reported, api.Diagnosed)
    assert found.remaining_rms < 0.1 * found.gap_rms
    json.dumps([found.to_json(), reported.to_json()], allow_nan=False)
    for name in ("diagnosed.yaml", "with_stand_ins.yaml", "report/report.html", "predicted.csv"):
        assert (desk / name).exists()
    driver, wanted = names["driver"], names["wanted"]
    assert 1e-5 < np.abs(driver.q - wanted).max() < 0.01  # type: ignore[attr-defined]


@pytest.mark.parametrize("job", [api.predict, api.compensate, api.fit, api.diagnose])
def test_a_log_of_another_arm_is_refused(desk: Path, job: Callable[..., object]) -> None:
    cell = api.load_cell(desk / "cell.yaml")
    log = api.read_log(desk / "log.csv", cell)
    row = "{a: 0.2, alpha: 0.3, d: 0.1, mass: 1}"
    (desk / "seven.yaml").write_text(f"robot: {{dh: [{', '.join([row] * 7)}]}}\n")
    seven = api.load_cell(desk / "seven.yaml")
    with pytest.raises(api.InputError, match=r"log\.csv: found a log of 6 joints, expected 7 as"):
        job(seven, log)
    with pytest.raises(api.InputError, match="found a log of 7 joints, expected 6"):
        api.diagnose(cell, log, simulated=replace(log, n=7))
