"""A log in pieces gives what it gives in one piece."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import ExcitationError, LogError
from gapbridge.core.estimation import pose_scatter, streamed
from gapbridge.core.estimation.identification import data_of, identify_compliance
from gapbridge.core.estimation.streamed import RowStore, identify_streamed
from gapbridge.core.estimation.streamed_fit import fold_slices
from gapbridge.core.log.log import Log, read_log
from gapbridge.core.log.pieces import LogPieces
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix, rotation_vector

COUNT, PIECE = 1500, 400


def nominal() -> Model:
    tool = np.eye(4)
    tool[:3, 3] = (0.04, -0.03, 0.15)
    return Model(builtin_arm("ur10e"), tool)


def measured_log(rotations: bool, shifted: bool, outlier: int = 0) -> Log:
    rng = np.random.default_rng(3)
    true = nominal().with_compliance([3e-6, 5e-6, 4e-6, 8e-6, 8e-6, 9e-6], [1e-6] * 6)
    if shifted:
        tool = true.tool_in_flange.copy()
        tool[:3, 3] += (0.001, -0.002, 0.0005)
        true = replace(true, tool_in_flange=tool)
    q = rng.uniform(-2.5, 2.5, (COUNT, 6))
    columns = {
        "actual_q": q,
        "payload": rng.choice([0.0, 4.0, 9.0], COUNT),
        "payload_cog": rng.normal(0, 0.05, (COUNT, 3)),
        "actual_TCP_force": rng.normal(0, 30, (COUNT, 6)) * [1, 1, 1, 0.1, 0.1, 0.1],
    }
    poses = true.predict(q, Log("truth", columns, 6).loads())
    frame = rotation_matrix(np.array([[0.1, -0.2, 0.7]]))[0] if shifted else np.eye(3)
    position = poses.position @ frame.T + (0.5 if shifted else 0.0)
    columns["measured_position"] = position + rng.normal(0, 2e-5, position.shape)
    columns["measured_position"][:outlier] += 0.02
    columns["measured_position"][40] = np.nan  # a row that nobody measured
    if rotations:
        columns["measured_rotation"] = rotation_vector(frame @ poses.rotation)
        columns["measured_rotation"] += rng.normal(0, 1e-5, position.shape)
    return Log("session", columns, 6)


def pieces_of(log: Log) -> list[Log]:
    return [log.select(slice(at, at + PIECE)) for at in range(0, len(log), PIECE)]


@pytest.mark.parametrize(
    ("rotations", "shifted", "outlier"), [(False, False, 0), (False, True, 20), (True, True, 0)]
)
def test_pieces_give_what_the_whole_gives(rotations, shifted, outlier):
    log, metrology = measured_log(rotations, shifted, outlier), Metrology(registered=not shifted)
    whole = identify_compliance(nominal(), log, metrology)
    found = identify_streamed(nominal(), pieces_of(log), metrology)
    for name in ("axial", "radial"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(whole, name), rtol=1e-9, atol=1e-15
        )
    np.testing.assert_allclose(found.std_axial, whole.std_axial, rtol=1e-6)
    np.testing.assert_allclose(found.tool_offset, whole.tool_offset, atol=1e-11)
    np.testing.assert_allclose(found.gap_rms, whole.gap_rms, rtol=1e-6)  # stop at small steps
    np.testing.assert_allclose(found.remaining_rms, whole.remaining_rms, rtol=1e-8)
    assert found.remaining_rms_held_out == pytest.approx(whole.remaining_rms_held_out, rel=0.05)
    assert (found.outliers == whole.outliers).all()
    assert found.notes == whole.notes
    assert found.samples == whole.samples == COUNT - 1


def test_links_that_bend_go_the_long_way_and_give_the_same():
    log, metrology = measured_log(False, False), Metrology(registered=True)
    from gapbridge.core.effects import Site, Term

    model = nominal().with_terms([Term("link_flexibility", Site(2), (1e-6,))])
    log = log.select(slice(0, 150))
    whole = identify_compliance(model, log, metrology)
    found = identify_streamed(model, pieces_of(log), metrology)
    np.testing.assert_allclose(found.axial, whole.axial, rtol=1e-8, atol=1e-15)


def test_a_log_without_loads_is_declined_as_ever():
    log = measured_log(False, False)
    light = replace(nominal(), arm=replace(nominal().arm, mass=np.zeros(6)))
    columns = {name: log.columns[name] for name in ("actual_q", "measured_position")}
    with pytest.raises(ExcitationError, match="nothing in the log excites"):
        identify_streamed(light, [replace(log, columns=columns)], Metrology(registered=True))


def written(log: Log, path: Path) -> Path:
    table = {}
    for name, values in log.columns.items():
        flat = values.reshape(len(values), -1)
        for k in range(flat.shape[1]):
            table[name if values.ndim == 1 else f"{name}_{k}"] = flat[:, k]
    if path.suffix == ".parquet":
        parquet.write_table(pa.table(table), path)
    else:
        rows = np.column_stack(list(table.values()))
        np.savetxt(path, rows, delimiter=",", header=",".join(table), comments="", fmt="%.17g")
    return path


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_file_in_pieces_holds_what_it_holds_in_one(tmp_path, suffix):
    path = written(measured_log(True, False), tmp_path / f"log{suffix}")
    whole, parts = read_log(path, 6), list(LogPieces(path, 6, 400))
    assert [len(part) for part in parts] == [400, 400, 400, 300]
    assert LogPieces(path, 6).count() == COUNT
    for name in whole.columns:
        np.testing.assert_array_equal(
            np.concatenate([part.columns[name] for part in parts]), whole.columns[name]
        )
    assert parts[2].line(5) == whole.line(805)
    approach = np.concatenate([part.loads().approach for part in parts])
    np.testing.assert_array_equal(approach, whole.loads().approach)


def test_a_joint_that_rests_over_the_seam_keeps_its_last_motion(tmp_path):
    q = np.zeros((12, 6))
    q[2:, 0], q[4:, 1], q[9:, 1] = 0.3, -0.2, 0.4
    path = written(Log("log", {"actual_q": q}, 6), tmp_path / "log.parquet")
    parts = [part.columns["approach"] for part in LogPieces(path, 6, 3)]
    np.testing.assert_array_equal(np.concatenate(parts), read_log(path, 6).approach())


def test_a_cell_that_is_no_number_is_named_in_a_later_piece(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("payload\n" + "1\n" * 500 + "heavy\n")
    with pytest.raises(LogError, match="row 502, column payload: found 'heavy'"):
        list(LogPieces(path, 6, 100))


def test_each_row_is_in_one_fold_and_folds_are_alike_in_size():
    counts, seen = np.zeros(5, dtype=int), []
    for number, rows in enumerate((1000, 1000, 3, 777)):
        for fold, part in fold_slices(number, rows):
            counts[fold] += part.stop - part.start
            seen += [(number, row) for row in range(part.start, part.stop)]
    assert len(seen) == len(set(seen)) == counts.sum() == 2780
    assert counts.min() > 0.97 * 2780 / 5


def test_more_rows_than_the_sample_give_what_all_of_them_give(monkeypatch):
    monkeypatch.setattr(streamed, "SAMPLE_ROWS", 300)
    log = measured_log(False, True, outlier=20)
    whole = identify_compliance(nominal(), log)
    found = identify_streamed(nominal(), pieces_of(log))
    np.testing.assert_array_equal(found.identifiable, whole.identifiable)
    spread = np.maximum(whole.std_axial, 1e-12)
    assert (np.abs(found.axial - whole.axial) < 0.02 * spread).all()
    np.testing.assert_array_equal(found.outliers, whole.outliers)
    assert found.remaining_rms == pytest.approx(whole.remaining_rms, rel=1e-3)
    assert found.remaining_rms_held_out == pytest.approx(whole.remaining_rms_held_out, rel=0.1)


def test_a_log_in_which_nothing_was_measured_is_declined():
    log = measured_log(False, False)
    none = replace(log, columns=log.columns | {"measured_position": np.full((COUNT, 3), np.nan)})
    for identify in (identify_streamed, identify_compliance):
        with pytest.raises(ExcitationError):
            identify(nominal(), [none] if identify is identify_streamed else none)


@pytest.mark.parametrize("first", [0, 1])
def test_the_sample_is_of_measured_rows_wherever_these_are(monkeypatch, first):
    monkeypatch.setattr(streamed, "SAMPLE_ROWS", 300)
    log = measured_log(False, False)
    position = np.full((COUNT, 3), np.nan)
    position[first::2] = log.columns["measured_position"][first::2]
    odd = replace(log, columns=log.columns | {"measured_position": position})
    stream = streamed._stream(pieces_of(odd), Metrology(registered=True), nominal())
    assert len(stream.sample.q) == len(stream.fold) == 300
    assert np.isfinite(stream.sample.position).all()
    assert len(np.unique(stream.sample.q[:, 0])) == 300


@pytest.mark.parametrize("first", [0, 1])
def test_two_loads_measured_in_turn_are_both_in_every_sample(monkeypatch, first):
    """At even distances all rows of a sample would be of one load."""
    monkeypatch.setattr(streamed, "SAMPLE_ROWS", 300)
    monkeypatch.setattr(streamed, "LINK_ROWS", 100)
    monkeypatch.setattr(pose_scatter, "MAX_ROWS", 100)
    log = measured_log(False, False)
    mass = np.where(np.arange(COUNT) % 2 == first, 0.0, 8.0)
    turns = replace(log, columns=log.columns | {"payload": mass})
    stream = streamed._stream(pieces_of(turns), Metrology(registered=True), nominal())
    seen = []
    monkeypatch.setattr(pose_scatter, "_rows", lambda fit, data, *_: seen.append(data) or 1 / 0)
    monkeypatch.setattr(streamed, "with_free_geometry", lambda fit, data: seen.append(data) or fit)
    shown = SimpleNamespace(kept=np.ones(12, dtype=bool))
    sample = replace(stream.sample, loads=replace(stream.sample.loads, payload_mass=np.resize(
        [0.0, 8.0], 300)))  # fmt: skip
    streamed._fit_with_geometry(
        SimpleNamespace(geometry=None), sample,
        SimpleNamespace(fit_sample=lambda before, rows: before),
    )  # fmt: skip
    with pytest.raises(ZeroDivisionError):
        pose_scatter.with_pose_scatter(None, sample, shown, 1.0)
    assert [len(data.q) for data in seen] == [100, 100]
    for data in (stream.sample, *seen):
        assert 0.3 < np.mean(data.loads.payload_mass > 0) < 0.7


def test_rows_that_wait_in_a_file_are_those_that_came():
    log = measured_log(True, False)
    data, rows = data_of(log, Metrology(registered=True))
    store = RowStore(memory=0)
    store.append(data, rows)
    ((kept, numbers),) = store
    assert store.count == len(rows)
    assert isinstance(kept.position, np.memmap)
    assert isinstance(kept.q, np.memmap)
    np.testing.assert_array_equal(numbers, rows)
    for name in ("q", "position", "rotation"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(data, name))
    np.testing.assert_array_equal(kept.loads.wrench, data.loads.wrench)
