"""Cells that commands write and commands read: fit and predict, to the last digit."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from cli_runs import (
    AXIAL,
    CELL,
    RADIAL,
    bent_model,
    cell_in,
    columns_of,
    gapbridge,
    log_in,
    measured,
    names,
    poses_and_loads,
    refused,
    table_of,
)

from gapbridge.bridge.cell import load_cell, save_cell
from gapbridge.core.rotation import rotation_matrix


def bent_cell(folder: Path) -> Path:
    save_cell(load_cell(cell_in(folder)), folder / "bent.yaml", bent_model())
    return folder / "bent.yaml"


def test_predict_writes_the_poses_of_the_deflected_arm_to_the_last_digit(tmp_path: Path) -> None:
    q, loads = poses_and_loads(7)
    log = log_in(tmp_path, columns_of(q, loads))
    answer = gapbridge("predict", log, "--cell", bent_cell(tmp_path), "--out", tmp_path / "p.csv")
    assert (answer.code, answer.err) == (0, "")
    header, table = table_of(tmp_path / "p.csv")
    assert header == [*names("predicted_position", 3), *names("predicted_rotation", 3)]
    poses = bent_model().predict(q, loads)
    np.testing.assert_array_equal(table[:, :3], poses.position)
    np.testing.assert_array_equal(table[:, 3:], poses.rotation_vector)


def test_a_fitted_cell_predicts_what_was_measured(tmp_path: Path) -> None:
    q, loads = poses_and_loads(40)
    columns = columns_of(q, loads)
    log = log_in(tmp_path, columns | measured(bent_model(), q, loads))
    new = tmp_path / "new.yaml"
    answer = gapbridge("fit", log, "--cell", cell_in(tmp_path), "--out", new)
    assert answer.code == 0, answer.err
    assert new.read_text(encoding="utf-8").startswith(CELL)  # comment, keys and order stay
    axial, radial = load_cell(new).model.compliance()
    # the TCP sits on the last axis: its own turn moves no point
    np.testing.assert_allclose(axial[1:5], AXIAL[1:5], rtol=1e-4)
    np.testing.assert_allclose(radial[:5], RADIAL[:5], rtol=1e-4)
    other_q, other_loads = poses_and_loads(15, seed=5)
    fresh = log_in(tmp_path, columns_of(other_q, other_loads), "fresh.csv")
    assert gapbridge("predict", fresh, "--cell", new, "--out", tmp_path / "p.csv").code == 0
    _, table = table_of(tmp_path / "p.csv")
    truth = bent_model().predict(other_q, other_loads).position
    rigid = bent_model().rigid_pose(other_q).position
    assert np.abs(table[:, :3] - truth).max() < 1e-4 * np.abs(rigid - truth).max()


def test_what_a_fit_of_a_rigid_arm_leaves_can_be_read_again(tmp_path: Path) -> None:
    q, loads = poses_and_loads(30)
    rigid = bent_model().without_terms()
    log = log_in(tmp_path, columns_of(q, loads) | measured(rigid, q, loads, noise=2e-5))
    new = tmp_path / "new.yaml"
    assert gapbridge("fit", log, "--cell", cell_in(tmp_path), "--out", new).code == 0
    axial, radial = load_cell(new).model.compliance()
    assert min(*axial, *radial) >= 0
    assert max(axial[1:3]) < 5e-7


def test_a_fit_writes_the_tool_point_it_found(tmp_path: Path) -> None:
    cell = cell_in(tmp_path)
    loose = CELL.replace("registered: true", "registered: false")
    cell.write_text(loose, encoding="utf-8")
    q, loads = poses_and_loads(60)
    deflected, shift = bent_model(), np.array([2e-3, -1e-3, 3e-3])
    poses = deflected.predict(q, loads)
    target = poses.position + poses.rotation @ shift
    seen = target @ rotation_matrix(np.array([0.3, 1.0, -2.0])).T + 2.0
    seen += 2e-5 * np.random.default_rng(1).normal(size=seen.shape)
    columns = {f"measured_position_{i}": seen[:, i] for i in range(3)}
    log, new = log_in(tmp_path, columns_of(q, loads) | columns), tmp_path / "new.yaml"
    answer = gapbridge("fit", log, "--cell", cell, "--out", new)
    assert answer.code == 0, answer.err
    assert "the tool point is written to the cell" in answer.out.replace("\n", " ")
    there = deflected.tool_in_flange[:3, 3] + deflected.tool_in_flange[:3, :3] @ shift
    np.testing.assert_allclose(load_cell(new).model.tool_in_flange[:3, 3], there, atol=2e-5)
    np.testing.assert_array_equal(
        load_cell(new).model.tool_in_flange[:3, :3], deflected.tool_in_flange[:3, :3]
    )


def test_a_fit_takes_no_target_beside_the_tcp_for_it_writes_no_frame_and_exact_zeros(
    tmp_path: Path,
) -> None:
    cell = cell_in(tmp_path)
    assert "registered: true" in cell.read_text(encoding="utf-8")
    loose = CELL.replace("registered: true", "registered: false")
    cell.write_text(loose, encoding="utf-8")
    q, loads = poses_and_loads(60)
    deflected = bent_model()
    poses = deflected.predict(q, loads)
    target = poses.position + poses.rotation @ np.array([0.02, 0.01, 0.05])
    seen = target @ rotation_matrix(np.array([0.3, 1.0, -2.0])).T + 2.0
    seen += 2e-5 * np.random.default_rng(1).normal(size=seen.shape)
    columns = {f"measured_position_{i}": seen[:, i] for i in range(3)}
    log, new = log_in(tmp_path, columns_of(q, loads) | columns), tmp_path / "new.yaml"
    answer = gapbridge("fit", log, "--cell", cell, "--out", new)
    assert answer.code == 0, answer.err
    assert new.read_text(encoding="utf-8").startswith(loose)
    fitted = load_cell(new).model
    np.testing.assert_array_equal(fitted.tool_in_flange, deflected.tool_in_flange)
    axial, radial = fitted.compliance()
    reported = re.findall(
        r"note: axial_compliance_(\d): not identifiable from these data, stays", answer.out
    )
    assert all(axial[int(joint) - 1] == 0.0 for joint in reported)
    assert all(v == 0 or v > 1e-9 for v in (*axial, *radial))
    assert "e-30" not in new.read_text(encoding="utf-8")
    assert "-0.0" not in answer.out
    before, after = re.findall(r"left out of the fit: (\S+) \(\S+\) before, (\S+) \(", answer.out)[
        0
    ]
    assert float(after) < 0.03 < 0.1 < float(before)  # mm


OUTPUTS = {
    "fit": ("--out", "new.yaml"), "predict": ("--out", "p.csv"), "compensate": ("--out", "c.csv"),
}  # fmt: skip


@pytest.mark.parametrize("command", OUTPUTS)
def test_columns_and_rows_that_change_the_loads_silently_are_warned_of(
    tmp_path: Path, command: str
) -> None:
    q, loads = poses_and_loads(40)
    columns = columns_of(q, loads) | measured(bent_model(), q, loads, noise=2e-5)
    columns["timestamp"] = np.where(np.arange(40) == 6, 0.0, np.arange(40.0))
    columns["session"] = np.zeros(40)
    columns = {k.replace("payload", "paylod"): v for k, v in columns.items()}
    option, name = OUTPUTS[command]
    log = log_in(tmp_path, columns)
    answer = gapbridge(command, log, "--cell", cell_in(tmp_path), option, tmp_path / name)
    assert answer.code == 0, answer.err
    for words in (
        "a column was left out; found paylod; did you mean payload?",
        "a column was left out; found paylod_cog_0; did you mean payload_cog_0?",
        "1 timestamp(s) run backwards (the first is row 8): rows should be in time order",
    ):
        assert answer.err.count(f"warning: {log}: {words}\n") == 1


def test_no_cause_is_written_for_poses_of_another_arm(tmp_path: Path) -> None:
    q, loads = poses_and_loads(40)
    inches = {k: v / 0.0254 for k, v in measured(bent_model(), q, loads).items()}
    log, new = log_in(tmp_path, columns_of(q, loads) | inches), tmp_path / "new.yaml"
    answer = gapbridge("diagnose", log, "--cell", cell_in(tmp_path), "--apply", new)
    assert answer.code == 0, answer.err
    assert "they look like inches, expected m" in answer.err
    assert "no cause is written into the cell" in answer.err
    assert load_cell(new).model.terms == load_cell(tmp_path / "cell.yaml").model.terms


def test_a_target_at_another_place_of_the_tool_is_fitted(tmp_path: Path) -> None:
    q, loads = poses_and_loads(40)
    tool = "tool: {tcp: {xyz: [0.06, 0.03, 0.0], rpy: [0, 0, 0]}}\n"
    cell = cell_in(tmp_path, CELL.replace("true", "false") + tool)
    log = log_in(tmp_path, columns_of(q, loads) | measured(bent_model(), q, loads))
    answer = gapbridge("fit", log, "--cell", cell, "--out", tmp_path / "new.yaml")
    assert answer.code == 0, answer.err
    assert "they look like the flange's, not the TCP's (tool.tcp)" in answer.err
    axial, _ = load_cell(tmp_path / "new.yaml").model.compliance()
    np.testing.assert_allclose(axial[1:3], AXIAL[1:3], rtol=1e-3)


def test_a_force_that_no_arm_bears_is_refused_and_a_fit_without_gain_is_warned_of(
    tmp_path: Path,
) -> None:
    q, loads = poses_and_loads(40)
    columns = columns_of(q, loads) | measured(bent_model(), q, loads)
    cell, new = cell_in(tmp_path), tmp_path / "new.yaml"
    columns["actual_TCP_force_0"] = np.full(40, 5000.0)
    answer = gapbridge("fit", log_in(tmp_path, columns), "--cell", cell, "--out", new)
    assert answer.code == 0, answer.err
    assert "the fit does not reduce the gap" in answer.err
    new.unlink()
    columns["actual_TCP_force_0"][3] = 1e6
    log = log_in(tmp_path, columns)
    for command, (option, name) in OUTPUTS.items():
        line = refused(command, log, "--cell", cell, option, tmp_path / name)
        assert "row 5, column actual_TCP_force_0: found 1000000.0, expected at most 10000" in line
        assert not (tmp_path / name).exists()


@pytest.mark.parametrize("command", ["fit", "diagnose"])
def test_a_cell_never_replaces_what_is_no_cell(tmp_path: Path, command: str) -> None:
    q, loads = poses_and_loads(40)
    log = log_in(tmp_path, columns_of(q, loads) | measured(bent_model(), q, loads))
    other = tmp_path / "precious.csv"
    other.write_text("a\n1\n")
    option = "--out" if command == "fit" else "--apply"
    line = refused(command, log, "--cell", cell_in(tmp_path), option, other)
    assert "precious.csv: found .csv, expected .yaml or .yml" in line
    assert other.read_text() == "a\n1\n"
