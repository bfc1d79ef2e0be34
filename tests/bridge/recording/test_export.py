"""Export: a recording becomes a log."""

from __future__ import annotations

import contextlib
import os
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from pyarrow import parquet
from recorded import Desk, N, publish, same_bits

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cli.log.large_log import LargeLog
from gapbridge.bridge.cli.main import gapbridge
from gapbridge.bridge.recording.export import Span, export, moment
from gapbridge.core.errors import InputError, LogError
from gapbridge.core.log.log import read_log
from gapbridge.core.log.mcap_reading import last_batch, read_batches
from gapbridge.core.log.mcap_records import chunk_offsets
from gapbridge.core.log.sources.recording import Recording
from gapbridge.core.log.sources.source import SourceOptions
from gapbridge.core.notes import Note, Reason


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path / "recordings")


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_the_log_holds_the_contracts_columns_bit_for_bit(
    desk: Desk, tmp_path: Path, suffix: str
) -> None:
    rows = desk.record(40, 40)
    out = tmp_path / f"log{suffix}"
    assert export(desk.stem, out).rows == 80
    log = read_log(out, N)
    for name in ("timestamp", "actual_q", "target_q", "payload_cog", "ft_raw_wrench", "payload"):
        expected = rows[:, desk.memory.slices[name]].reshape(log.require(name).shape)
        assert same_bits(log.require(name), expected.copy()), name
    assert not log.has("joint_temperatures")  # no cycle has them
    beside = ("nominal_q_5", "corrected_q_0", "offset_5", "written", "state")
    assert set(beside) <= set(log.unknown)


def test_states_are_written_as_text(desk: Desk, tmp_path: Path) -> None:
    desk.record(3)
    export(desk.stem, tmp_path / "log.csv")
    lines = (tmp_path / "log.csv").read_text().splitlines()
    assert lines[0].endswith(",state")
    assert lines[3].endswith(",observing")
    export(desk.stem, tmp_path / "log.parquet")
    table = parquet.read_table(tmp_path / "log.parquet")
    assert table["state"].to_pylist() == ["observing"] * 3


def test_a_stretch_is_given_from_the_beginning_from_the_end_or_by_the_calendar(
    desk: Desk, tmp_path: Path
) -> None:
    desk.record(100, 100)  # one cycle every 2 ms
    out = tmp_path / "log.csv"

    def rows(start: float | datetime | None, stop: float | datetime | None) -> list[int]:
        export(desk.stem, out, Span(start, stop))
        number = out.read_text().splitlines()[0].split(",").index("number")
        return [int(float(line.split(",")[number])) for line in out.read_text().splitlines()[1:]]

    assert rows(0.0999, 0.1021) == [50, 51]
    assert rows(-0.0041, None) == [197, 198, 199]
    assert rows(None, -0.3939) == [0, 1, 2]
    begin = next(batch.log_time[0] for batch in read_batches(desk.stem) if len(batch)) / 1e9
    at = datetime.fromtimestamp(begin + 0.1001, UTC)
    assert rows(at, None)[0] == 51
    with pytest.raises(LogError, match="found no cycles there"):
        rows(5.0, None)


def test_bounds_that_mean_nothing_are_refused() -> None:
    beyond = ("9999-12-31T23:59:59-23:59", "0001-01-01T00:00:00+23:59")
    for text in ("yesterday", "nan", "inf", "", "1_0", *beyond):
        with pytest.raises(InputError, match="expected seconds from the beginning"):
            moment(text)


def test_gaps_and_a_clock_that_goes_back_are_reported(desk: Desk, tmp_path: Path) -> None:
    recorder = desk.recorder()
    publish(desk.memory, 10)
    recorder.step(flush=True)
    publish(desk.memory, 5)
    recorder._reader.next += 5  # as if the ring had been overwritten
    first = publish(desk.memory, 1)
    assert first[0, 0] == 15
    desk.memory._rows[15, 1] = 0.0
    recorder.close()
    runner = CliRunner()
    done = runner.invoke(gapbridge, ["export", str(desk.stem), "--out", str(tmp_path / "l.csv")])
    assert done.exit_code == 0, done.output
    assert "5 cycles in between were not recorded" in done.output
    assert "row 12: the controller's clock goes back" in done.output


def damage(path: Path, chunk: int, place: int = 60) -> int:
    """Flip a bit ``place`` bytes behind where the data of a chunk begins; returns where that is."""
    with path.open("rb") as file:
        start = list(chunk_offsets(file, path))[chunk][0]
    raw = bytearray(path.read_bytes())
    raw[start + place] ^= 0x10
    path.write_bytes(raw)
    return start


@pytest.mark.parametrize("place", [-9, -8, -7, 60])
@pytest.mark.parametrize("whole", [True, False])
def test_behind_a_damaged_chunk_reading_goes_on_and_the_file_stays_as_it_is(
    desk: Desk, tmp_path: Path, place: int, whole: bool
) -> None:
    desk.record(20, 20, 20)
    (path,) = desk.files
    start = damage(path, 2, place)  # in the chunk's opcode, its length, its data
    if not whole:
        os.truncate(path, path.stat().st_size - 8)
    before = path.read_bytes()
    done = CliRunner().invoke(gapbridge, ["export", str(path), "--out", str(tmp_path / "l.csv")])
    assert "l.csv: 40 cycles over" in done.output, done.output
    assert f"warning: {path.name}: chunk at byte {start - 9} is damaged: " in done.output
    assert " bytes were left out\n" in done.output
    assert path.read_bytes() == before


def test_a_finished_file_is_read_where_its_first_chunk_is_damaged(
    desk: Desk, tmp_path: Path
) -> None:
    rows = desk.record(20, 20)
    (path,) = desk.files
    start = damage(path, 0)
    out = tmp_path / "l.csv"
    done = CliRunner().invoke(gapbridge, ["export", str(path), "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert f"warning: {path.name}: chunk at byte {start - 9} is damaged: " in done.output
    kept = read_log(out, N).require("timestamp")  # that chunk held the file's definitions only
    assert same_bits(kept, rows[:, desk.memory.slices["timestamp"]].ravel().copy())
    batch = last_batch(path)
    assert batch is not None and len(batch)


def test_a_recording_read_in_pieces_tells_what_is_damaged(
    desk: Desk, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    desk.record(20, 20, 20)
    (path,) = desk.files
    damage(path, 1)
    cell = tmp_path / "cell.yaml"
    cell.write_text("robot: {model: ur10e}\n")
    with contextlib.suppress(LogError):  # its numbers are no arm's
        next(iter(LargeLog(path, load_cell(cell))))
    assert re.search(rf"note: {re.escape(str(path))}: .*is damaged: ", capsys.readouterr().err)


def test_rows_without_the_force_of_a_lost_sensor_are_left_out_and_noted(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "recordings")
    recorder, memory = desk.recorder(), desk.memory
    for cycle in range(30):
        row = memory.next_row()
        row[1:] = 0.1
        row[memory.slices["timestamp"]] = 0.002 * cycle
        if 10 <= cycle < 14:
            row[memory.slices["actual_TCP_force"]] = np.nan
        memory.publish()
    recorder.step(flush=True)
    recorder.close()
    found = Recording().read(desk.stem, (), SourceOptions())
    assert np.isfinite(found.columns["actual_TCP_force"]).all()
    kept = [cycle for cycle in range(30) if not 10 <= cycle < 14]
    np.testing.assert_allclose(found.columns["timestamp"], 0.002 * np.array(kept))
    assert found.notes == (Note(Reason.MISSING, (4, "actual_TCP_force")),)


@pytest.mark.parametrize("segment_size", [256.0, 0.001])
def test_a_column_without_a_value_for_a_whole_chunk_or_file_stays_and_is_noted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], segment_size: float
) -> None:
    desk = Desk(tmp_path / "recordings", segment_size=segment_size)
    recorder, memory = desk.recorder(), desk.memory
    for chunk in range(4):
        for _ in range(10):
            row = memory.next_row()
            row[1:] = 0.1
            row[memory.slices["timestamp"]] = 0.002 * memory.written
            row[memory.slices["joint_temperatures"]] = np.nan  # never reported
            if chunk == 2:
                row[memory.slices["ft_raw_wrench"]] = np.nan
            memory.publish()
        recorder.step(flush=True)
    recorder.close()
    assert (len(desk.files) > 3) is (segment_size < 1)
    found = Recording().read(desk.stem, (), SourceOptions())
    silent = np.isnan(found.columns["ft_raw_wrench"]).all(axis=1)
    assert list(np.flatnonzero(silent)) == list(range(20, 30))
    assert not np.isnan(found.columns["actual_q"]).any()
    assert "joint_temperatures" not in found.columns
    assert found.notes == (Note(Reason.MISSING, (10, "ft_raw_wrench")),)
    cell = tmp_path / "cell.yaml"
    cell.write_text("robot: {model: ur10e}\n")
    pieces = list(LargeLog(desk.stem, load_cell(cell)))
    assert [len(piece) for piece in pieces] == [10] * 4
    assert {tuple(sorted(piece.columns)) for piece in pieces} == {
        tuple(sorted({*found.columns, "approach"}))
    }
    note = f"note: {desk.stem}: 10 rows without a value of ft_raw_wrench\n"
    assert capsys.readouterr().err == note


def test_the_command_writes_beside_the_recording_and_gives_the_cell_back(
    desk: Desk, tmp_path: Path
) -> None:
    desk.record(3)
    recorder = desk.recorder()
    recorder.configuration["text"] = "robot: {model: ur10e}\n"
    publish(desk.memory, 3)
    recorder.step(flush=True)
    recorder.close()
    runner = CliRunner()
    done = runner.invoke(gapbridge, ["export", str(desk.files[0])])
    assert done.exit_code == 0
    log = desk.files[0].with_suffix(".csv")
    assert re.match(rf"{re.escape(str(log))}: 3 cycles over 0\.004 s \(3 observing\)", done.output)
    cell = tmp_path / "cell.yaml"
    done = runner.invoke(gapbridge, ["export", str(desk.files[1]), "--cell-out", str(cell)])
    assert cell.read_text() == "robot: {model: ur10e}\n"
    assert done.output.endswith(f"{cell}: written\n")
    same = str(tmp_path / "same.csv")
    done = runner.invoke(
        gapbridge, ["export", str(desk.files[1]), "--out", same, "--cell-out", same]
    )
    assert "found for two outputs" in str(done.exception)
    beyond = [str(desk.files[1]), "--from", "100", "--cell-out", str(tmp_path / "no.yaml")]
    assert runner.invoke(gapbridge, ["export", *beyond]).exit_code != 0
    assert not (tmp_path / "no.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "phrase"),
    [
        (["missing"], "missing: file not found, expected a recording"),
        (["{recording.parent}"], "found a folder, expected a recording"),
        (["{recording}", "--out", "log.txt"], "found .txt, expected .csv or .parquet"),
        (["{recording}", "--from", "noon"], "--from: found 'noon'"),
        (["{recording}", "--out", "{recording}.csv/x.csv"], "found no folder"),
    ],
)
def test_what_cannot_be_exported_is_one_line(desk: Desk, arguments: list[str], phrase: str) -> None:
    desk.record(3)
    given = [argument.format(recording=desk.stem) for argument in arguments]
    done = CliRunner().invoke(gapbridge, ["export", *given])
    assert phrase in str(done.exception)


@pytest.mark.slow
def test_a_long_recording_is_exported_in_pieces(desk: Desk, tmp_path: Path) -> None:
    recorder = desk.recorder()
    for _ in range(6):
        publish(desk.memory, 5000)
        recorder.step(flush=True)
    recorder.close()
    export(desk.stem, tmp_path / "log.parquet")
    file = parquet.ParquetFile(tmp_path / "log.parquet")
    assert file.metadata.num_rows == 30_000
    assert file.metadata.num_row_groups == 2
    assert np.all(np.diff(file.read(["timestamp"])["timestamp"].to_numpy()) > 0)
