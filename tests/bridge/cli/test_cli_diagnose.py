"""``gapbridge diagnose``: its files, its text, its errors."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runs import (
    CELL,
    Array,
    bent_model,
    cell_in,
    columns_of,
    gapbridge,
    log_in,
    measured,
    poses_and_loads,
    refused,
    table_of,
)

import gapbridge.bridge.cli.log.diagnose as command
from gapbridge.bridge.cell import load_cell
from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis import diagnosis as core
from gapbridge.core.dynamics import predict_wrench, with_pieces
from gapbridge.core.effects import Site, Term
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion

SOFT = Model(builtin_arm("ur10e")).with_terms([Term("axial_compliance", Site(2), (2e-5,))])


def soft_log(folder: Path, model: Model = SOFT) -> Path:
    q, loads = poses_and_loads(40)
    return log_in(folder, columns_of(q, loads) | measured(model, q, loads, noise=2e-5))


def test_no_cause_of_a_misread_sensor_is_written(tmp_path: Path) -> None:
    """Of the wrong sign it showed another centre of gravity; the positions' cause stays."""
    q, loads = poses_and_loads(40)
    loads = replace(loads, wrench=np.zeros((40, 6)))
    at_rest = Motion.at_rest(q, loads)
    wrench = -predict_wrench(SOFT, with_pieces(SOFT, at_rest))
    wrench += np.random.default_rng(1).normal(0, 0.3, wrench.shape) * np.repeat([1, 0.1], 3)
    columns = columns_of(q, loads) | measured(SOFT, q, loads, noise=2e-5)
    columns |= {f"ft_raw_wrench_{j}": wrench[:, j] for j in range(6)}
    log, new = log_in(tmp_path, columns), tmp_path / "new.yaml"
    answer = gapbridge("diagnose", log, "--cell", cell_in(tmp_path), "--apply", new)
    assert answer.code == 0, answer.err
    (line,) = answer.err.splitlines()
    assert line.startswith(f"warning: {log}: ft_raw_wrench seems to have the wrong sign")
    assert line.endswith("; no cause of wrench is written into the cell")
    assert "cause: payload_cog" in answer.out
    text = new.read_text(encoding="utf-8")
    assert "channel: position" in text
    assert "channel: wrench" not in text
    written = load_cell(new).model
    assert "payload_cog" not in {term.effect for term in written.terms}
    assert written.compliance()[0][1] == pytest.approx(2e-5, rel=0.1)


def test_what_is_found_is_reported_written_and_predicts(tmp_path: Path) -> None:
    folder, new, file = tmp_path / "out", tmp_path / "new.yaml", tmp_path / "d.json"
    log = soft_log(tmp_path)
    answer = gapbridge(
        "diagnose", log, "--cell", cell_in(tmp_path),
        "--out", folder, "--json", file, "--apply", new,
    )  # fmt: skip
    assert (answer.code, answer.err) == (0, "")
    reported = json.loads(file.read_text(encoding="utf-8"))
    assert reported == json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    assert "axial_compliance" in (folder / "report.html").read_text(encoding="utf-8")
    assert reported["schema"] == "gapbridge.diagnosis/1"
    (cause,) = reported["channels"][0]["causes"]
    assert (cause["effect"], cause["joints"]) == ("axial_compliance", [2])
    for words in ("verdict: explained", "axial_compliance of joint 2", "µrad/Nm", "±", "shrinks"):
        assert words in answer.out
    assert "wrench: not observable here; needs ft_raw_wrench" in answer.out
    assert new.read_text(encoding="utf-8").startswith(CELL)
    axial, _ = load_cell(new).model.compliance()
    assert axial[1] == cause["parameters"][0]["value"]
    assert gapbridge("predict", log, "--cell", new, "--out", tmp_path / "p.csv").code == 0
    q, loads = poses_and_loads(40)
    _, table = table_of(tmp_path / "p.csv")
    truth, rigid = SOFT.predict(q, loads).position, SOFT.rigid_pose(q).position
    assert np.abs(table[:, :3] - truth).max() < 0.05 * np.abs(rigid - truth).max()


def test_names_that_are_not_utf8_are_escaped_in_every_document(tmp_path: Path) -> None:
    log, new, folder = (tmp_path / os.fsdecode(b) for b in (b"b\xff.csv", b"n\xff.yaml", b"o\xff"))
    soft_log(tmp_path).rename(log)
    cell = cell_in(tmp_path)
    answer = gapbridge("diagnose", log, "--cell", cell, "--out", folder, "--apply", new)
    assert (answer.code, answer.err) == (0, "")
    document = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    assert document["provenance"]["files"][0]["name"] == r"b\udcff.csv"
    assert r"log b\udcff.csv" in (folder / "report.html").read_text(encoding="utf-8")
    origin = load_cell(new).file.provenance
    assert origin is not None
    assert origin.files[0].name == r"b\udcff.csv"
    assert origin.arguments["apply"] == str(tmp_path / r"n\udcff.yaml")


def test_the_folder_of_the_report_may_hold_the_other_files(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    answer = gapbridge(
        "diagnose", soft_log(tmp_path), "--cell", cell_in(tmp_path), "--out", folder,
        "--json", folder / "gap.json", "--apply", folder / "better.yaml",
    )  # fmt: skip
    assert (answer.code, answer.err) == (0, "")
    written = {"diagnosis.json", "report.html", "gap.json", "better.yaml"}
    assert {path.name for path in folder.iterdir()} == written


def test_a_reader_who_leaves_early_costs_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def leave(_: object) -> str:
        raise KeyboardInterrupt  # or a pipe that is broken

    monkeypatch.setattr(command, "diagnosis_text", leave)
    file = tmp_path / "d.json"
    gapbridge("diagnose", soft_log(tmp_path), "--cell", cell_in(tmp_path), "--json", file)
    assert json.loads(file.read_text(encoding="utf-8"))["schema"] == "gapbridge.diagnosis/1"


@pytest.mark.parametrize(
    "outputs",
    [("--json", "same", "--apply", "same"), ("--out", ".", "--apply", "report.html")],
)
def test_two_outputs_are_two_files(tmp_path: Path, outputs: tuple[str, ...]) -> None:
    given = [tmp_path / word if k % 2 else word for k, word in enumerate(outputs)]
    line = refused("diagnose", soft_log(tmp_path), "--cell", cell_in(tmp_path), *given)
    assert "found for two outputs, expected two files" in line


def test_a_withheld_effect_is_never_named(tmp_path: Path) -> None:
    file = tmp_path / "d.json"
    answer = gapbridge(
        "diagnose", soft_log(tmp_path), "--cell", cell_in(tmp_path), "--json", file,
        "--withhold", "axial_compliance", "--withhold", "stiffness_nonlinearity",
    )  # fmt: skip
    assert answer.code == 0, answer.err
    channel = json.loads(file.read_text(encoding="utf-8"))["channels"][0]
    named = {c["effect"] for c in channel["causes"] + channel["considered"]}
    assert not named & {"axial_compliance", "stiffness_nonlinearity"}


def test_the_cell_is_written_also_when_nothing_is_found(tmp_path: Path) -> None:
    log, new = soft_log(tmp_path, SOFT.without_terms()), tmp_path / "new.yaml"
    answer = gapbridge("diagnose", log, "--cell", cell_in(tmp_path), "--apply", new)
    assert answer.code == 0, answer.err
    assert "verdict: no gap" in answer.out
    assert not any(load_cell(new).model.compliance()[0])
    assert load_cell(new).model.terms == ()


def test_stand_ins_go_into_the_cell_only_when_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, cell = soft_log(tmp_path), cell_in(tmp_path)
    genuine = core.diagnose
    play = Term("backlash", Site(3), (2e-4,), stand_in=True)

    def with_one(*given: object, **more: object) -> object:
        found = genuine(*given, **more)  # type: ignore[arg-type]
        return replace(found, with_stand_ins=found.with_stand_ins.with_terms([play]))

    monkeypatch.setattr(core, "diagnose", with_one)
    texts = []
    for options in ((), ("--stand-ins",)):
        new = tmp_path / f"new{len(options)}.yaml"
        answer = gapbridge("diagnose", log, "--cell", cell, "--apply", new, *options)
        assert answer.code == 0, answer.err
        texts.append(new.read_text(encoding="utf-8"))
    assert "stand_in: true" not in texts[0]
    assert texts[1].count("stand_in: true") == 1
    line = refused("diagnose", log, "--cell", cell, "--stand-ins")
    assert "found no --apply" in line


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--withhold", "backlsh"), ["--withhold", "'backlsh'", "did you mean 'backlash'"]),
        (("--out", "{}/none/out"), ["found no folder", "none"]),
        (("--out", "{}/log.csv"), ["found a file", "expected a folder"]),
        (("--out", "{}/taken"), ["taken/report.html: found a folder"]),
        (("--out", "{}/o", "--json", "{}/o/report.html"), ["o/report.html: found for two outputs"]),
        (("--json", "{}/none/d.json"), ["found no folder"]),
        (("--apply", "{}/cell.yaml"), ["output to be the input"]),
        (("--apply", "{}"), ["found a folder"]),
        (("--json", "{}/both", "--apply", "{}/both"), ["two outputs", "two files"]),
        (("--sim", "{}/none.csv"), ["none.csv: file not found"]),
        (("--sim", "{}/short.csv"), ["short.csv", "found 3 rows, expected 40"]),
    ],
)
def test_unusable_options_are_refused_before_any_work(
    tmp_path: Path, options: tuple[str, ...], words: list[str]
) -> None:
    log = soft_log(tmp_path)
    (tmp_path / "taken" / "report.html").mkdir(parents=True)
    (tmp_path / "short.csv").write_text("payload\n1\n2\n3\n", encoding="utf-8")
    given = [option.format(tmp_path) for option in options]
    line = refused("diagnose", log, "--cell", cell_in(tmp_path), *given)
    for word in words:
        assert word in line


OUTPUT = {"predict": "csv", "fit": "yaml"}


@pytest.mark.parametrize("name", ["diagnose", "predict", "fit"])
def test_degrees_are_called_degrees(tmp_path: Path, name: str) -> None:
    q, loads = poses_and_loads(30)
    columns = columns_of(np.degrees(q), loads) | measured(SOFT, q, loads)
    more = () if name == "diagnose" else ("--out", tmp_path / f"o.{OUTPUT[name]}")
    line = refused(name, log_in(tmp_path, columns), "--cell", cell_in(tmp_path), *more)
    assert "log.csv" in line
    assert "look like degrees, expected rad" in line


def test_a_log_without_a_channel_reports_what_each_needs(tmp_path: Path) -> None:
    q, loads = poses_and_loads(30)
    line = refused("diagnose", log_in(tmp_path, columns_of(q, loads)), "--cell", cell_in(tmp_path))
    for word in ("log.csv", "measured_position", "ft_raw_wrench", "target_q"):
        assert word in line


def test_a_simulators_log_reaches_the_diagnosis_row_by_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    q, loads = poses_and_loads(40)
    simulated = log_in(tmp_path, measured(SOFT, q, loads), "sim.csv")
    seen: list[Log] = []
    real = core.diagnose

    def watched(*arguments: object, simulated: Log, **options: object) -> object:
        seen.append(simulated)
        return real(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(core, "diagnose", watched)
    log, cell = soft_log(tmp_path), cell_in(tmp_path)
    assert gapbridge("diagnose", log, "--cell", cell, "--sim", simulated).code == 0
    np.testing.assert_array_equal(
        seen[0].require("measured_position"), SOFT.predict(q, loads).position
    )


def test_a_gap_of_rounding_is_none(tmp_path: Path) -> None:
    q, loads = poses_and_loads(40)
    given = measured(SOFT, q, loads)
    simulated = log_in(tmp_path, given, "sim.csv")
    for i in range(3):
        given[f"measured_position_{i}"] = given[f"measured_position_{i}"] + 1e-12 * q[:, i] ** 2
    log, out = log_in(tmp_path, columns_of(q, loads) | given), tmp_path / "found.json"
    cell = cell_in(tmp_path)
    assert gapbridge("diagnose", log, "--cell", cell, "--sim", simulated, "--json", out).code == 0
    assert json.loads(out.read_text())["verdict"] == "no_gap"


def spoilt(table: dict[str, Array], name: str, change: Callable[[Array], Array]) -> None:
    """Change the column, or the columns ``name_0..``, in place."""
    for key in [k for k in table if k == name or k.rpartition("_")[0] == name]:
        table[key] = change(table[key])


def hole(column: Array) -> Array:
    return np.where(np.arange(len(column)) == 5, np.nan, column)


SPOILT: dict[str, tuple[str, Callable[[Array], Array], list[str]]] = {
    "an angle that is no number": ("actual_q", hole, ["row 7, column actual_q_0", "found nothing"]),
    "a payload that is no number": ("payload", hole, ["row 7, column payload", "found nothing"]),
    "an endless force": (
        "actual_TCP_force", lambda v: hole(v) * np.inf, ["actual_TCP_force_0", "finite"],
    ),
    "degrees": ("actual_q", np.degrees, ["actual_q_*", "look like degrees, expected rad"]),
    "millimetres": (
        "measured_position", lambda v: 1e3 * v, ["measured_position_*", "look like millimetres"],
    ),
    "grams": ("payload", lambda v: 1e3 * v, ["column payload:", "looks like grams, expected kg"]),
    "a centre in mm": ("payload_cog", lambda v: 1e3 * v, ["payload_cog_*", "looks like mm"]),
    "kelvin": (
        "joint_temperatures", lambda v: v + 273.15, ["joint_temperatures_*", "look like kelvin"],
    ),
    "rotations in degrees": (
        "measured_rotation", np.degrees, ["measured_rotation_*", "look like degrees"],
    ),
    "a payload below zero": ("payload", lambda v: v - 1, ["column payload", "expected 0 or more"]),
}  # fmt: skip


def full_table(rows: int = 40) -> dict[str, Array]:
    q, loads = poses_and_loads(rows)
    table = columns_of(q, loads) | measured(SOFT, q, loads, noise=2e-5)
    turned = SOFT.predict(q, loads).rotation_vector
    table |= {f"measured_rotation_{i}": turned[:, i] for i in range(3)}
    return table | {f"joint_temperatures_{i}": np.linspace(25, 30, rows) for i in range(6)}


@pytest.mark.parametrize("mistake", SPOILT)
def test_unusable_values_are_refused_by_name(tmp_path: Path, mistake: str) -> None:
    name, change, words = SPOILT[mistake]
    table = full_table()
    spoilt(table, name, change)
    line = refused("diagnose", log_in(tmp_path, table), "--cell", cell_in(tmp_path))
    for word in ["log.csv", *words]:
        assert word in line


def test_a_load_under_which_the_arm_would_buckle_is_refused_by_its_row(tmp_path: Path) -> None:
    table = full_table()
    table["actual_TCP_force_2"] = np.where(np.arange(40) == 16, 9e3, 0.0)
    table |= {f"actual_TCP_force_{i}": np.zeros(40) for i in (0, 1, 3, 4, 5)}
    cell = cell_in(tmp_path, CELL + "compliance: {axial: [3.0e-4, 3.0e-4, 3.0e-4, 0, 0, 0]}\n")
    line = refused("diagnose", log_in(tmp_path, table), "--cell", cell)
    assert "log.csv: row 17: the arm finds no equilibrium" in line


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["found an empty file"]),
        ("actual_q_0,payload\n", ["found no data rows"]),
        ("actual_q_0,payload\n1,2\n1\n", ["row 3", "found 1 cells, expected 2"]),
        ("actual_q_0,payload\n1,two\n", ["row 2, column payload", "found 'two'"]),
        ("actual_q_0,actual_q_1\n0,0\n", ["actual_q_2: not found, expected 6 columns"]),
        ("payload,payload\n0,0\n", ["column payload: found twice"]),
        ("acutal_q_0,posn\n0,0\n", ["found 'acutal_q_0', did you mean 'actual_q_0'?"]),
        ("\x00\xff\n", ["log.csv"]),
    ],
)
def test_files_that_are_no_log_are_refused(tmp_path: Path, text: str, words: list[str]) -> None:
    log = tmp_path / "log.csv"
    log.write_bytes(text.encode("latin-1"))
    line = refused("diagnose", log, "--cell", cell_in(tmp_path))
    for word in ["log.csv", *words]:
        assert word in line


def test_a_measured_axis_that_is_missing_is_named(tmp_path: Path) -> None:
    table = full_table()
    del table["measured_position_2"]
    line = refused("diagnose", log_in(tmp_path, table), "--cell", cell_in(tmp_path))
    assert "column measured_position_2: not found" in line


def test_odd_rows_and_names_are_reported_where_work_is_still_possible(tmp_path: Path) -> None:
    table = full_table()
    spoilt(table, "measured_position", hole)
    table = {k.replace("joint_temperatures", "joint_temperature"): v for k, v in table.items()}
    table["timestamp"] = np.repeat(np.arange(20), 2) * 10.0
    answer = gapbridge("diagnose", log_in(tmp_path, table), "--cell", cell_in(tmp_path))
    assert answer.code == 0, answer.err
    assert "axial_compliance of joint 2" in answer.out
    for words in (
        "note: 20 timestamp(s) are repeated",
        "note: 1 row(s) have no measured position (empty, or three zeros) and were left out",
        "did you mean joint_temperatures_0?",
    ):
        assert words in answer.out


@pytest.mark.slow
def test_a_log_of_another_arm_is_diagnosed_and_reported_as_such(tmp_path: Path) -> None:
    q, loads = poses_and_loads(60)
    columns = {f"actual_q_{i}": q[:, i] for i in range(6)}
    assert loads.wrench is not None
    columns |= {f"actual_TCP_force_{i}": loads.wrench[:, i] for i in range(6)}
    columns |= measured(bent_model(), q, loads, noise=2e-5)
    other = cell_in(tmp_path, CELL.replace("ur10e", "ur5e").replace("true", "false"))
    answer = gapbridge("diagnose", log_in(tmp_path, columns), "--cell", other)
    assert answer.code == 0, answer.err
    assert "do not follow the arm" in answer.err


def test_five_poses_for_forty_parameters_end_without_a_traceback(tmp_path: Path) -> None:
    cell = cell_in(tmp_path, CELL.replace("true", "false"))
    table = {k: v[:5] for k, v in full_table().items() if "rotation" not in k}
    answer = gapbridge("diagnose", log_in(tmp_path, table), "--cell", cell)
    assert (answer.code, answer.err) == (0, "")
    assert "over 5 samples" in answer.out
    few = {k: v[:3] for k, v in table.items()}
    line = refused("diagnose", log_in(tmp_path, few), "--cell", cell)
    assert "position: at least 4 rows (found 3)" in line
    same = {k: np.repeat(v[:1], 30) for k, v in table.items()}
    line = refused("diagnose", log_in(tmp_path, same), "--cell", cell)
    assert "position: at least 4 different poses (found 1 in 30 rows)" in line


@pytest.mark.parametrize("left", [3e-4, 0.0])
def test_apply_writes_the_total_of_what_has_become_less(tmp_path: Path, left: float) -> None:
    q, loads = poses_and_loads(60)
    sides = np.random.default_rng(2).choice([-1.0, 1.0], q.shape)
    play = Term("backlash", Site(2), (left,))
    now = Model(builtin_arm("ur10e"), terms=(play,))
    columns = columns_of(q, loads) | {f"approach_{i}": sides[:, i] for i in range(6)}
    log = log_in(tmp_path, columns | measured(now, q, replace(loads, approach=sides), noise=2e-5))
    held = "effects:\n  - {effect: backlash, joint: 2, parameters: {value: 2.0e-3}}\n"
    new = tmp_path / "new.yaml"
    answer = gapbridge("diagnose", log, "--cell", cell_in(tmp_path, CELL + held), "--apply", new)
    assert answer.code == 0, answer.err
    assert "verdict: explained" in answer.out
    cell = load_cell(new)
    total = sum(t.values[0] for t in cell.model.terms)
    assert total == pytest.approx(left, abs=3e-5)
    low, high = cell.intervals["backlash_2"]
    assert (low + high) / 2 == pytest.approx(total, abs=1e-9)
    assert len(cell.model.terms) == (total != 0.0)
