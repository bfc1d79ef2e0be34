"""``gapbridge predict``: its standard deviation, rows outside what was fitted, other channels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cli.main import main
from gapbridge.bridge.document.output_file import LONG, write_table
from gapbridge.core.loads import Loads

Array = NDArray[np.float64]
SIGMA = 2e-5
CELL = """\
robot: {model: ur10e}
tool: {tcp: {xyz: [0, 0, 0.18], rpy: [0, 0, 0]}}
metrology: {registered: true, sigma: 2.0e-5}
"""
JOINTS = [f"actual_q_{i}" for i in range(6)] + [f"target_q_{i}" for i in range(6)]
LOAD = ["payload", *(f"payload_cog_{i}" for i in range(3))]


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(a) for a in arguments])
    return int(ended.value.code or 0)


def write_log(folder: Path, name: str, count: int, seed: int, wide: float = 0.7) -> Array:
    """Write a log of a hidden arm's poses; return their true TCP positions (N, 3), m."""
    model = load_cell(folder / "cell.yaml").model
    hidden = model.with_compliance((3e-6, 8e-6, 7e-6, 1e-5, 1.2e-5, 2e-5), (2e-6,) * 6)
    rng = np.random.default_rng(seed)
    q = np.array([0, -1.5, 1.5, -1.8, -1.5, 0]) + rng.uniform(-wide, wide, (count, 6))
    mass, cog = rng.choice([1.0, 9.0], count), np.tile([0, 0, 0.08], (count, 1))
    true = hidden.predict(q, Loads(payload_mass=mass, payload_cog=cog)).position
    measured = true + rng.normal(0, SIGMA, true.shape)
    names = ["timestamp", *JOINTS, *LOAD, *(f"measured_position_{i}" for i in range(3))]
    table = np.column_stack([np.arange(count), q, q, mass, cog, measured])
    np.savetxt(folder / name, table, "%.12g", ",", header=",".join(names), comments="")
    return true


def read(path: Path) -> NDArray[np.void]:
    return np.genfromtxt(path, delimiter=",", names=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a rigid cell, and one fitted from a log."""
    folder = tmp_path_factory.mktemp("predict")
    (folder / "cell.yaml").write_text(CELL, encoding="utf-8")
    write_log(folder, "fit.csv", 60, 1)
    cell, out = folder / "cell.yaml", folder / "new.yaml"
    assert run("fit", folder / "fit.csv", "--cell", cell, "--out", out) == 0
    return folder


def test_the_standard_deviation_is_what_predictions_miss(folder: Path) -> None:
    true = write_log(folder, "b.csv", 600, 2, wide=0.6)
    out = folder / "b_out.csv"
    assert run("predict", folder / "b.csv", "--cell", folder / "new.yaml", "--out", out) == 0
    predicted = read(out)
    off = np.stack([predicted[f"predicted_position_{i}"] - true[:, i] for i in range(3)])
    std = np.stack([predicted[f"predicted_position_std_{i}"] for i in range(3)])
    # one fit: its few errors are shared by all rows, so that the ratio scatters by a half
    assert 0.4 < np.sqrt(np.mean((off / std) ** 2)) < 2.0
    assert np.corrcoef(np.abs(off).ravel(), std.ravel())[0, 1] > 0.2


def test_rows_outside_what_was_fitted_are_marked_and_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(folder, "c.csv", 40, 3, wide=1.3)
    out = folder / "c_out.csv"
    assert run("predict", folder / "c.csv", "--cell", folder / "new.yaml", "--out", out) == 0
    marked = read(out)["outside_fitted"]
    low, high = load_cell(folder / "new.yaml").fitted_range["actual_q_0"]
    q = read(folder / "c.csv")["actual_q_0"]
    beyond = (q < low - 0.1) | (q > high + 0.1)
    assert beyond.any()
    assert marked[beyond].all()
    said = capsys.readouterr().out
    assert f"outside what was fitted: {int(marked.sum())} of 40 rows (" in said


def test_a_cell_of_which_nothing_was_fitted_says_so(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = folder / "plain.csv"
    assert run("predict", folder / "fit.csv", "--cell", folder / "cell.yaml", "--out", out) == 0
    assert read(out).dtype.names == tuple(
        f"predicted_{kind}_{i}" for kind in ("position", "rotation") for i in range(3)
    )
    assert "keeps no covariance of a fit" in capsys.readouterr().out


def test_a_parameter_that_is_none_is_named_with_file_and_key(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = folder / "stale.yaml"
    text = (folder / "cell.yaml").read_text()
    cell.write_text(f"{text}\nprovenance: {{parameters: [foo_9], covariance: [[1.0]]}}\n")
    arguments = ("predict", folder / "fit.csv", "--cell", cell, "--out", folder / "stale.csv")
    assert run(*arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"error: {cell}, line ")
    assert ": provenance.parameters entry 1: found 'foo_9', expected a parameter" in said


def test_channels_are_predicted_beside_the_pose(folder: Path) -> None:
    out = folder / "channels.csv"
    arguments = ("predict", folder / "fit.csv", "--cell", folder / "new.yaml", "--out", out)
    assert run(*arguments, "--channels") == 0
    predicted, log = read(out), read(folder / "fit.csv")
    weight = np.sqrt(sum(predicted[f"predicted_wrench_{i}"] ** 2 for i in range(3)))
    np.testing.assert_allclose(weight, log["payload"] * 9.80665, rtol=1e-9)
    for i in range(6):
        np.testing.assert_allclose(predicted[f"predicted_q_{i}"], log[f"target_q_{i}"])
    assert np.abs(predicted["predicted_torque_1"]).max() > 20.0  # Nm, the shoulder holds the arm


def test_what_a_channel_lacks_is_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = read(folder / "fit.csv")
    kept = [n for n in log.dtype.names or () if not n.startswith("target_q")]
    table = np.column_stack([log[n] for n in kept])
    np.savetxt(folder / "few.csv", table, "%.12g", ",", header=",".join(kept), comments="")
    out = folder / "few_out.csv"
    arguments = ("predict", folder / "few.csv", "--cell", folder / "new.yaml", "--out", out)
    assert run(*arguments, "--channels") == 0
    assert "no tracking predicted: needs target_q" in capsys.readouterr().out


def test_a_covariance_of_another_size_is_refused_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = yaml.safe_load((folder / "new.yaml").read_text(encoding="utf-8"))
    cell["provenance"]["parameters"].append("axial_compliance_1")
    bad = folder / "bad.yaml"
    bad.write_text(yaml.safe_dump(cell), encoding="utf-8")
    out = folder / "bad.csv"
    assert run("predict", folder / "fit.csv", "--cell", bad, "--out", out) == 2
    error = capsys.readouterr().err
    assert "provenance" in error
    assert "Traceback" not in error


@pytest.mark.slow
def test_a_diagnosis_that_is_applied_keeps_the_covariance_of_its_causes(folder: Path) -> None:
    write_log(folder, "d.csv", 60, 4)
    applied = folder / "applied.yaml"
    arguments = ("diagnose", folder / "d.csv", "--cell", folder / "cell.yaml")
    assert run(*arguments, "--apply", applied) == 0
    cell = load_cell(applied)
    assert "axial_compliance_2" in cell.spread.names
    assert np.isfinite(cell.spread.poses_and_std(cell.model, np.zeros((1, 6)), None)[1]).all()


def test_long_tables_read_back_exactly(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    table = rng.normal(size=(LONG // 4, 5)) * 10.0 ** rng.integers(-300, 300, (LONG // 4, 5))
    table[:2] = [[np.nan, 0.0, -0.0, 1.0, 1e22], [np.inf, -np.inf, 5e-324, 0.1, 3.0]]
    write_table(tmp_path / "long.csv", list("abcde"), table)
    text = (tmp_path / "long.csv").read_text(encoding="utf-8")
    assert text.startswith("a,b,c,d,e\n")
    read = np.loadtxt(tmp_path / "long.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(read, table)
    assert (np.signbit(read) == np.signbit(table)).all()
