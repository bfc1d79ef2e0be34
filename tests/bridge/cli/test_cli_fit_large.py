"""``gapbridge fit`` and others with logs that are read in pieces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from cli_runs import (
    CELL,
    bent_model,
    cell_in,
    columns_of,
    gapbridge,
    measured,
    poses_and_loads,
    refused,
)
from pyarrow import parquet

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cli.log import large_log
from gapbridge.core.log.pieces import LogPieces
from gapbridge.drivers.clock import SYSTEM

SOFT = """\
compliance: {axial: [1.0e-4, 1.0e-4, 1.0e-4, 0, 0, 0]}
limits: {offset: 0.1, offset_rotation: 0.5}
"""
Columns = dict[str, np.ndarray]


def parquet_in(folder: Path, columns: Columns) -> Path:
    parquet.write_table(pa.table(columns), folder / "log.parquet")
    return folder / "log.parquet"


def read_table(path: Path) -> Columns:
    if path.suffix == ".parquet":
        found = parquet.read_table(path)
        return {name: found[name].to_numpy() for name in found.column_names}
    table = np.genfromtxt(path, delimiter=",", names=True)
    return {name: table[name] for name in table.dtype.names or ()}


def session(rows: int) -> Columns:
    q, loads = poses_and_loads(rows)
    return columns_of(q, loads) | measured(bent_model(), q, loads, noise=2e-5)


def test_a_large_log_gives_what_it_gives_in_one_piece(tmp_path, monkeypatch):
    log, cell = parquet_in(tmp_path, session(900)), cell_in(tmp_path)
    whole = gapbridge("fit", log, "--cell", cell, "--out", tmp_path / "whole.yaml")
    assert whole.code == 0, whole.err
    monkeypatch.setattr(large_log, "LARGE_ROWS", 500)
    monkeypatch.setattr(large_log, "LogPieces", lambda path, n, *_: LogPieces(path, n, 200))
    parts = gapbridge("fit", log, "--cell", cell, "--out", tmp_path / "parts.yaml")
    assert parts.code == 0, parts.err
    one, other = (load_cell(tmp_path / f"{name}.yaml").model for name in ("whole", "parts"))
    for a, b in zip(one.compliance(), other.compliance(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("command", ["predict", "compensate"])
def test_a_log_in_pieces_is_predicted_and_compensated_as_one(
    tmp_path, monkeypatch, command, suffix
):
    """The numbers, the rows named and the warnings are those of the whole log."""
    log, cell = parquet_in(tmp_path, session(900)), cell_in(tmp_path)
    fitted = tmp_path / "fitted.yaml"
    assert gapbridge("fit", log, "--cell", cell, "--out", fitted).code == 0
    wide = session(900)
    wide["actual_q_1"] = wide["actual_q_1"] + np.where(np.arange(900) % 100 == 50, 2.5, 0.0)
    log = parquet_in(tmp_path, wide)
    found = []
    for name in ("whole", "parts"):
        out = tmp_path / f"{name}{suffix}"
        result = gapbridge(command, log, "--cell", fitted, "--out", out)
        assert result.code == 0, result.err
        found.append((result.out.replace(name, ""), result.err, read_table(out)))
        monkeypatch.setattr(large_log, "LARGE_ROWS", 500)
        monkeypatch.setattr(large_log, "LogPieces", lambda path, n, *_: LogPieces(path, n, 200))
    (said, warned, whole), (said_too, warned_too, parts) = found
    assert (said, warned) == (said_too, warned_too)
    assert "9 of 900 rows lie outside" in warned
    assert list(whole) == list(parts)
    for name, values in whole.items():
        np.testing.assert_allclose(parts[name], values, rtol=0, atol=1e-7)


def test_a_row_without_equilibrium_is_named_by_its_line_in_any_piece(tmp_path, monkeypatch):
    columns = session(900)
    fitted = cell_in(tmp_path, CELL + SOFT)
    columns["actual_TCP_force_2"][640] = -9e3
    log = parquet_in(tmp_path, columns)
    for _ in ("whole", "pieces"):
        for command in ("predict", "compensate"):
            text = refused(command, log, "--cell", fitted, "--out", tmp_path / "new.csv")
            assert "log.parquet: row 642: the arm finds no equilibrium" in text
            assert not (tmp_path / "new.csv").exists()
        monkeypatch.setattr(large_log, "LARGE_ROWS", 500)
        monkeypatch.setattr(large_log, "LogPieces", lambda path, n, *_: LogPieces(path, n, 200))


def test_a_fault_far_down_a_large_log_names_its_row(tmp_path, monkeypatch):
    columns = session(900)
    columns["payload"][777] = 500.0
    log, cell = parquet_in(tmp_path, columns), cell_in(tmp_path)
    monkeypatch.setattr(large_log, "LARGE_ROWS", 500)
    text = refused("fit", log, "--cell", cell, "--out", tmp_path / "new.yaml")
    assert "row 779, column payload: found 500 kg" in text


@pytest.mark.parametrize(
    ("before", "encoding"), [("", "utf-8"), ("# by the tracker\n\n", "utf-8"), ("#\n", "utf-16")]
)
def test_sessions_of_a_large_log_are_fitted_apart_whatever_stands_before_its_header(
    tmp_path, monkeypatch, before, encoding
):
    """The instrument's frame differs between the sessions: together they cannot be fitted."""
    columns, cell = session(60), cell_in(tmp_path, CELL.replace("true", "false"))
    late = np.arange(60) >= 30
    columns["measured_position_0"] = columns["measured_position_0"] + 0.1 * late
    columns["session"] = late.astype(float)
    lines = [",".join(columns)] + [",".join(map(repr, row)) for row in zip(*(
        values.tolist() for values in columns.values()), strict=True)]  # fmt: skip
    log = tmp_path / "log.csv"
    log.write_text(before + "\n".join(lines) + "\n", encoding=encoding)
    monkeypatch.setattr(large_log, "LARGE_BYTES", 1000)
    assert large_log.has_sessions(log)
    answer = gapbridge("fit", log, "--cell", cell, "--out", tmp_path / "new.yaml")
    assert answer.code == 0, answer.err
    found, true = (
        m.compliance()[0] for m in (load_cell(tmp_path / "new.yaml").model, bent_model())
    )
    np.testing.assert_allclose(found[1:3], true[1:3], rtol=0.05)


def test_a_large_log_with_bytes_that_are_no_text_is_refused(tmp_path, monkeypatch):
    log = tmp_path / "log.csv"
    log.write_bytes(b"# \xe9\nactual_q_0\n")
    monkeypatch.setattr(large_log, "LARGE_BYTES", 5)
    line = refused("fit", log, "--cell", cell_in(tmp_path), "--out", tmp_path / "new.yaml")
    assert "log.csv: found bytes that are no text" in line


@pytest.mark.parametrize(("rows", "large"), [(20_000, False), (20_001, True)])
def test_a_log_is_large_from_its_number_of_rows_on(tmp_path, rows, large):
    log = parquet_in(tmp_path, {"payload": np.zeros(rows)})
    assert large_log.is_large(log) == large


def test_a_recording_that_holds_no_measured_poses_says_so(tmp_path):
    from gapbridge.bridge.cell.settings.recording import RecordingSettings
    from gapbridge.bridge.ipc.shared_memory import SharedMemory
    from gapbridge.bridge.recording.recorder import Recorder

    page = SharedMemory(6, clock=SYSTEM)
    settings = RecordingSettings(folder=tmp_path, keep_free=0.0)
    recorder = Recorder(
        settings, "run-20260101-000000", page, {"joints": 6}, lambda reported: None, clock=SYSTEM
    )
    for number in range(40):
        row = page.next_row()
        row[1:] = 0.1
        row[page.slices["timestamp"]] = 0.002 * number
        page.publish()
    recorder.step(flush=True)
    recorder.close()
    run = tmp_path / "run-20260101-000000-001.mcap"
    text = refused("fit", run, "--cell", cell_in(tmp_path), "--out", tmp_path / "new.yaml")
    assert "found no measured_position_0..2" in text


def test_a_recording_of_nothing_is_refused(tmp_path):
    recording = tmp_path / "run-001.mcap"
    recording.write_bytes(b"\x89MCAP0\r\n")  # a run that was killed before its first chunk
    out = tmp_path / "new.yaml"
    assert "found no cycles" in refused("fit", recording, "--cell", cell_in(tmp_path), "--out", out)
    assert not out.exists()
